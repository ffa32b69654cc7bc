"""The radio field: what surfaces send, point sources, and `RadioField`, their sum."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.field.radiance import Surface as Surface
    from rf3dgs.field.radio_field import RadioField as RadioField
    from rf3dgs.field.sources import PointSource as PointSource
    from rf3dgs.field.sources import estimate_transmitter as estimate_transmitter

__all__ = ["PointSource", "RadioField", "Surface", "estimate_transmitter"]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "RadioField": ".radio_field",
        "Surface": ".radiance",
        "PointSource": ".sources",
        "estimate_transmitter": ".sources",
    },
)
