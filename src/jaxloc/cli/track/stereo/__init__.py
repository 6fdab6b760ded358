"""``jaxloc track`` of stereo sequences."""
