"""A rendered street with stereo images and ground truth."""

from jaxloc.data.simulate.street import rendering, sequence, textures, world
from jaxloc.data.simulate.street.rendering import Intrinsics, Rectangles, Rendering, join_rectangles, render
from jaxloc.data.simulate.street.sequence import MovingObject, StreetFrame, StreetSequence, simulate_street
from jaxloc.data.simulate.street.textures import TextureAtlas, make_noise, make_street_textures, pack_textures
from jaxloc.data.simulate.street.world import Mover, Road, Street, make_box, make_street, rotation_y

__all__ = [
    "Intrinsics",
    "Mover",
    "MovingObject",
    "Rectangles",
    "Rendering",
    "Road",
    "Street",
    "StreetFrame",
    "StreetSequence",
    "TextureAtlas",
    "join_rectangles",
    "make_box",
    "make_noise",
    "make_street",
    "make_street_textures",
    "pack_textures",
    "render",
    "rendering",
    "rotation_y",
    "sequence",
    "simulate_street",
    "textures",
    "world",
]
