"""What can be chosen about array spectra; free of heavy imports, so that `--help` is instant."""

import math
from dataclasses import dataclass, field
from typing import Literal

from rf3dgs.core.errors import InputError

Method = Literal["ideal", "bartlett", "tapered", "capon", "music", "cbf", "tcbf", "mvdr"]
Averaging = Literal["forward", "forward-backward"]
Rule = Literal["relative", "absolute", "snr"]
Criterion = Literal["mdl", "aic"]
AVERAGINGS = ("forward", "forward-backward")
RULES = ("relative", "absolute", "snr")
CRITERIA = ("mdl", "aic")


@dataclass(frozen=True)
class Loading:
    """How much is added to the diagonal of a covariance."""

    amount: float = 1e-3
    """How much, in the unit of the rule."""
    rule: Rule = "relative"
    """"relative": times the mean element power. "absolute": a power [linear] in the unit of the covariance. "snr": the
    noise of a receiver with this signal-to-noise ratio [dB], taken as not yet in the covariance."""

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise InputError(f"a loading's rule must be one of {', '.join(RULES)}; got {self.rule!r}")
        if not math.isfinite(self.amount) or (self.rule != "snr" and self.amount < 0):
            raise InputError(f"a {self.rule} loading must be finite and, as a power, not negative; got {self.amount}")


@dataclass(frozen=True)
class ArrayProcessing:
    """How an array's covariance is measured, averaged and read."""

    snapshots: int | None = 256
    """Frequencies that the covariance is the mean over, coherent as a receiver measures them; None for paths taken as
    uncorrelated."""
    bandwidth: float = 2e9
    """What the frequencies span [Hz]."""
    taps: tuple[float, float] | None = None
    """Only the delay taps between these two [s] count; all of them unless given."""
    snr_db: float | None = None
    """Signal-to-noise ratio at the elements [dB]; no noise unless given."""
    averaging: Averaging = "forward"
    """"forward-backward" averages with the array turned by half a turn: it separates two coherent sources."""
    subarray: tuple[int, int] | None = None
    """Rows and columns of a part of the array; the mean over all such parts separates coherent sources and takes the
    place of the array. The whole array unless given."""
    loading: Loading = field(default_factory=Loading)
    """What Capon adds to the diagonal before it inverts."""
    sources: int | Criterion | None = None
    """Sources that MUSIC looks for: a number, or counted from the eigenvalues by "mdl" (unless given) or "aic"."""

    def __post_init__(self) -> None:
        if self.averaging not in AVERAGINGS:
            raise InputError(f"averaging must be one of {', '.join(AVERAGINGS)}; got {self.averaging!r}")
        if not isinstance(self.loading, Loading):
            raise InputError(f"loading must be a Loading, such as Loading(1e-3); got {self.loading!r}")
        if isinstance(self.sources, str) and self.sources not in CRITERIA:
            raise InputError(f'sources must be a number, "mdl" or "aic"; got {self.sources!r}')
        if not (math.isfinite(self.bandwidth) and self.bandwidth > 0):
            raise InputError(f"bandwidth must be a positive number of Hz; got {self.bandwidth}")
