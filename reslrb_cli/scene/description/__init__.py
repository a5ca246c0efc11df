"""What a scene's files say, before Mitsuba makes objects of it: read, named, mended, checked, and built."""

from .building import build
from .checking import check
from .including import Description, read_description
from .mending import mend
from .naming import name_objects
from .notes import Note
from .placing import place_textures
from .sizes import FilmSize, check_sizes, film_sizes
from .sizing import resize_films
from .writing import tag_lines

__all__ = [
    "Description",
    "FilmSize",
    "Note",
    "build",
    "check",
    "check_sizes",
    "film_sizes",
    "mend",
    "name_objects",
    "place_textures",
    "read_description",
    "resize_films",
    "tag_lines",
]
