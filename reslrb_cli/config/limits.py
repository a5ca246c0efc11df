"""How large what a user hands in may be: each bound with its reason. Beyond one, input is refused at once."""

from __future__ import annotations

# --- configurations: read within a second or two, at some 50 microseconds a value -------------------------------------

#: Bytes of a configuration's file. One with every default written out takes 2 kB.
CONFIG_BYTES = 2**18
#: Number of `--set`, and characters of all of them together.
OVERRIDES = 1000
OVERRIDES_LENGTH = 2**16
#: Values and keys of a configuration, with every alias and every `<<` spelt out: a few hundred bytes of aliases of
#: aliases can stand for billions. A parameter with every default written out has some 20.
NODES = 20_000
#: Sections within sections. The deepest setting, `target.render.parameters.KEY.file`, is five deep.
DEPTH = 20
#: Characters of a parameter's key or glob. To make a pattern of one takes time that grows with the square of it.
KEY_LENGTH = 1000
#: Integers are below this, and above its negative: nothing that a file counts has more than 64 bits.
INTEGER_END = 2**64

# --- names and paths --------------------------------------------------------------------------------------------------

#: Bytes of a part of a path: no file system in use takes more.
PART_BYTES = 255
#: Bytes of a whole path. Linux takes 4095; the rest is for what a run adds to it below its folder.
PATH_BYTES = 3000
#: Bytes of a run's folder: PART_BYTES, less what is put before and behind it: `-2` and so on, and the mark of a
#: folder that is not whole yet.
NAME_BYTES = 200

# --- paths of light ---------------------------------------------------------------------------------------------------

#: Segments of a path that a limit can name; beyond it -1 says the same. Roulette lets at most 95 % of the paths go on
#: at each vertex: of 10^20 paths not one is a thousand vertices longer than `rr_depth`.
PATH_LENGTH = 2**16 - 1
#: Entries of an array in a kernel's thread-local memory: Dr.Jit's bound.
LOCAL_ENTRIES = 2**16
#: Connections, or events, that are kept of a path. Each is code of its own in the kernel, and the time to compile it
#: grows faster than their number: on two cores 64 took seconds, 256 most of a minute.
CAPACITY = 1024
#: Light paths of one pass: their numbers have 32 bits.
PASS_PATHS = 2**32 - 1
#: Samples per pixel of one pass. In single precision a sum loses terms below a 2^24th of it, and thousands of such
#: passes can be added to one another.
PASS_SAMPLES = 2**18
#: Passes of a step, each of which is launched by itself and has a seed that is made before the first of them.
PASSES = 2**16

# --- files that a configuration names ---------------------------------------------------------------------------------

#: Pixels of an image: 16384 x 8192, the largest environment map in use. Decoded they take 1.5 GiB.
PIXELS = 2**27
#: Bytes of an image's file: that many pixels of four floats, not compressed, and something for the file's head.
IMAGE_BYTES = 16 * PIXELS + 2**20
