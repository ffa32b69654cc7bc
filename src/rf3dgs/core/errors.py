"""The package's errors. Each message says what was expected, what came and what to do."""


class RfError(Exception):
    """Base of every error this package raises on purpose; the command line prints it as one sentence."""


class InputError(RfError, ValueError):
    """An argument is wrong: shape, range, unit or combination."""


class DataError(RfError):
    """A file or folder is wrong, damaged or unsafe; the message names it."""


class SealedError(RfError):
    """The sealed test set was asked for without its flag."""


class TrainingError(RfError):
    """Training cannot go on; the last good state has been kept."""


class MissingDependencyError(RfError, ImportError):
    """An optional package or a system library is missing; the message says how to install it."""
