"""What each part of a mirror field explains of the spectra it was trained on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.grids import view_of
from rf3dgs.core.threads import on_threads
from rf3dgs.field.lit import LitSurface
from rf3dgs.field.rays import Rays
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.rasterize import Backend

NAMES = {
    "sources": "power by point sources",
    "lit": "power by lit surfaces",
    "ambient": "power by ambient light",
    "sources_db": "RMSE of point sources [dB]",
    "laws_db": "RMSE of point sources and laws [dB]",
    "whole_db": "RMSE [dB]",
}
"""What `Explained` is called in a field's meta."""


@dataclass(frozen=True)
class Explained:
    """Shares of the power of the spectra that the parts of a field send, over all directions and positions: sources,
    lit, ambient. What is left of 1 is missing, or too much where it is negative.

    sources_db, laws_db, whole_db: RMSE of the level in the window [dB], by solid angle: of the point sources alone,
    with the laws of lit and ambient surfaces, and with the residual.
    """

    sources: float
    lit: float
    ambient: float
    sources_db: float
    laws_db: float
    whole_db: float

    def meta(self) -> dict[str, str | int | float | bool]:
        """The numbers under names that a person can read, to four digits."""
        return {name: round(getattr(self, key), 4) for key, name in NAMES.items()}

    @classmethod
    def of_meta(cls, meta: Mapping[str, object]) -> "Explained | None":
        """What a field's meta says, None where it says nothing."""
        values = {key: meta.get(name) for key, name in NAMES.items()}
        if any(not isinstance(value, int | float) for value in values.values()):
            return None
        return cls(**{key: float(str(value)) for key, value in values.items()})

    def text(self) -> str:
        """One line for a log."""
        missing = 1 - self.sources - self.lit - self.ambient
        return (
            f"of the measured power {self.sources:.0%} is explained by point sources, {self.lit:.0%} by lit surfaces, "
            f"{self.ambient:.0%} by ambient light, {missing:.0%} by nothing; RMSE {self.sources_db:.1f} dB with point "
            f"sources alone, {self.laws_db:.1f} dB with the laws, {self.whole_db:.1f} dB with the residual"
        )


def explained(
    surface: LitSurface, rays: Sequence[Rays], spectra: Spectrum, window: DbWindow, backend: Backend = "auto"
) -> Explained:
    """What `surface` and the `rays` of each position explain of `spectra` `[position, row, col]`."""
    area = spectra.grid.solid_angle / spectra.grid.solid_angle.sum()
    # Each with the residual, but for the first.
    parts = (surface.without_residual(), surface.only("lit"), surface.only("ambient"))

    def of(each: tuple[int, Rays]) -> tuple[Tensor, Tensor]:
        one, arriving = spectra[each[0]], each[1]
        with torch.no_grad():
            values = torch.cat([part.values(one.pose.position, csi=False) for part in parts], -1)
            shown = surface.seen(values, view_of(one.pose, one.grid), backend)
        points = arriving.picture(one.pose, one.grid, one.instrument)
        laws, lit, ambient = (shown * surface.unit).unbind(-1)
        truth = window.encode(one.power)
        gaps = [window.encode(shown) - truth for shown in (points, points + laws, points + lit + ambient)]
        power = [(part.double() * area).sum() for part in (one.power, points, lit, ambient)]
        errors = [((gap.double() * window.span_db).square() * area).sum() for gap in gaps]
        return torch.stack(power), torch.stack(errors)

    powers, errors = (torch.stack(column) for column in zip(*on_threads(of, enumerate(rays)), strict=True))
    power = powers.sum(0)
    return Explained(*(power[1:] / power[0]).tolist(), *errors.mean(0).sqrt().tolist())
