"""``jaxloc track``."""
