"""``jaxloc odometry``."""
