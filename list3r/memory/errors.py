"""The errors a user can meet. Every message names the thing that is wrong, its value, and how to put it right."""


class List3rError(Exception):
    """Base of every error that is the user's to mend; the command line prints it in one line and exits with 2."""


class SourceError(List3rError):
    """A video or folder that cannot be read as frames."""


class FrameError(List3rError):
    """One frame of a source that cannot be decoded; the frame is skipped and counted."""


class OptionError(List3rError):
    """A value of an option or argument that makes no sense."""


class MemoryFileError(List3rError):
    """A memory file that is absent, foreign, damaged, locked, or of a newer schema."""


class UnknownIdError(List3rError):
    """An instance id that the memory has never held."""


class TrackingError(List3rError):
    """A video in which the camera cannot be followed."""


class BaselineError(TrackingError):
    """A stretch through which the camera moves too little for depth from colour."""


class DegenerateError(List3rError):
    """Correspondences that do not determine a transform: too few, collinear, or without extent."""


class SpaceMismatchError(List3rError):
    """Vectors of two different embedding spaces in one comparison."""


class ExportError(List3rError):
    """An export that cannot be written."""
