"""The method: image → structure tensor map → η → statistics → split plan → new parameters.

It needs torch and gsplat alone, so that any training loop can use it.
"""
