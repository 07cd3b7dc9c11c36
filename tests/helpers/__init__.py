"""What several test modules share: drawn and random scenes, short runs, processes, and stand-ins for gsplat."""
