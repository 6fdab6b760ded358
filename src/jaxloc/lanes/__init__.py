"""Lane detection: RALPH, Dickmanns's edge sums, inverse perspective mapping, lane departure."""

from jaxloc.lanes import departure, dickmanns, ground_view, lane, ralph
from jaxloc.lanes.lane import Lane

__all__ = ["Lane", "departure", "dickmanns", "ground_view", "lane", "ralph"]
