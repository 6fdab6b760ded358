"""``jaxloc localize``."""
