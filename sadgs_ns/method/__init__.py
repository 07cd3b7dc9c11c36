"""The method: image → structure tensor map → η → statistics → split plan → parameters, with torch and gsplat alone."""
