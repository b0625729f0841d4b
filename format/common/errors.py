"""Everything KPC raises on purpose.

    KpcError
     ├─ UsageError      the command line asks for something that makes no sense (exit code 2)
     ├─ DatasetError    a folder of videos or images cannot be used
     ├─ MediaError      ffmpeg, an image or a video failed
     ├─ FormatError     a .kpc file is damaged, hostile or of an unknown version
     │   └─ BudgetError   it would need more memory than the reader was given
     ├─ NetworkError    a server does not give what it should
     │   ├─ UnreachableError   it cannot be reached, or breaks off again and again; it may do so no longer
     │   └─ InterruptedRead    what was being read is not wanted so soon any more; nothing is wrong
     ├─ TrainingError   training cannot start or go on
     └─ DisplayError    no OpenGL, or no window to be had
         └─ ContextLostError   the graphics card was reset, and all that it held is gone

A message is one line: it names the file (or the option) and the remedy. `kpc.format.common.cli.run` alone turns it into a line
on stderr and an exit code; anything else that is raised is a bug and keeps its traceback.
"""


class KpcError(Exception):
    """Base of every error KPC raises on purpose."""


class UsageError(KpcError):
    """The command line asks for something that makes no sense."""


class DatasetError(KpcError):
    """A folder of videos or images cannot be used."""


class MediaError(KpcError):
    """ffmpeg, an image or a video failed."""


class FormatError(KpcError):
    """A .kpc file is damaged, hostile or of an unknown version."""


class BudgetError(FormatError):
    """A .kpc file would need more memory than the reader was given."""


class NetworkError(KpcError):
    """A server does not give what it should."""


class UnreachableError(NetworkError):
    """A server cannot be reached, or breaks off again and again; it may do so no longer."""


class InterruptedRead(NetworkError):
    """What was being read is not wanted so soon any more; nothing is wrong."""


class TrainingError(KpcError):
    """Training cannot start or go on."""


class DisplayError(KpcError):
    """No OpenGL, or no window to be had."""


class ContextLostError(DisplayError):
    """The graphics card was reset, and all that it held is gone."""
