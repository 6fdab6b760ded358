"""``jaxloc calibrate``."""
