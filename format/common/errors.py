"""Every error that KPC raises on purpose.

    KpcError
     ├─ UsageError               the command line or an argument asks for something impossible (exit code 2)
     ├─ DatasetError             a folder of videos or images cannot be used
     ├─ MediaError               ffmpeg failed, or an image or video cannot be read or written
     ├─ FormatError              a .kpc file is damaged, hostile or of an unsupported version
     │   └─ BudgetError          reading it would need more memory than the reader was given
     ├─ NetworkError             a server's answer cannot be used
     │   ├─ UnreachableError     the server cannot be reached, or connections keep breaking off
     │   └─ InterruptedRead      a read was cancelled in favour of a more urgent one; nothing is wrong
     ├─ TrainingError            training cannot start or continue
     └─ DisplayError             there is no OpenGL, or no window can be opened
         └─ ContextLostError     the graphics card was reset and everything on it is lost

A message is one line that names the file or option and the remedy. `kpc.format.common.cli.run` alone prints it and
chooses the exit code. Any other exception is a bug and keeps its traceback.
"""


class KpcError(Exception):
    """Base class of every error that KPC raises on purpose."""


class UsageError(KpcError):
    """The command line or an argument asks for something impossible."""


class DatasetError(KpcError):
    """A folder of videos or images cannot be used."""


class MediaError(KpcError):
    """ffmpeg failed, or an image or video cannot be read or written."""


class FormatError(KpcError):
    """A .kpc file is damaged, hostile or of an unsupported version."""


class BudgetError(FormatError):
    """Reading a .kpc file would need more memory than the reader was given."""


class NetworkError(KpcError):
    """A server's answer cannot be used."""


class UnreachableError(NetworkError):
    """A server cannot be reached, or connections keep breaking off; trying again later may help."""


class InterruptedRead(NetworkError):
    """A read was cancelled in favour of a more urgent one; nothing is wrong."""


class TrainingError(KpcError):
    """Training cannot start or continue."""


class DisplayError(KpcError):
    """There is no OpenGL, or no window can be opened."""


class ContextLostError(DisplayError):
    """The graphics card was reset and everything on it is lost."""
