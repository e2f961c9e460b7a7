"""The exception tree: everything that drakegrasp raises because of a caller's mistake.

* DrakegraspError
  * ConfigError          a configuration value, key or preset that cannot be used
  * MeshError            a mesh that cannot become a simulated object
  * HandError            a hand description (SDFormat and YAML) that cannot be used
  * DataError            a dataset, shard or manifest that is missing, foreign or broken
  * GraspError           a grasp vector, or its frame, that cannot be verified
    * OffSurfaceError    a grasp whose contacts are not on the object
  * MachineError         something that the machine lacks (EGL, a usable Drake, workers)
    * DiskFullError      no room to write; what was begun is gone, and the work goes on later
    * BlankImageError    OpenGL gave an image of nothing

Failures of the physics are not here: they are values, see `drakegrasp.outcomes`.
Messages follow one pattern: what, what it must be, what it was.
"""


class DrakegraspError(Exception):
    """Base class of all errors raised on purpose; catch this one."""


class ConfigError(DrakegraspError, ValueError):
    """A configuration value, key or preset that cannot be used."""


class MeshError(DrakegraspError, ValueError):
    """A mesh that cannot become a simulated object, with the reason."""


class HandError(DrakegraspError, ValueError):
    """A hand description that cannot be used."""


class DataError(DrakegraspError, ValueError):
    """A dataset, shard or manifest that is missing, foreign or broken."""


class GraspError(DrakegraspError, ValueError):
    """A grasp vector, or its frame, that cannot be verified."""


class OffSurfaceError(GraspError):
    """A grasp whose contacts are not on the object's surface."""


class MachineError(DrakegraspError, RuntimeError):
    """Something that this machine lacks, with the line that mends it."""


class DiskFullError(MachineError):
    """No room to write a file: what was begun of it is gone."""


class BlankImageError(MachineError):
    """OpenGL gave an image of nothing, which must never become data."""
