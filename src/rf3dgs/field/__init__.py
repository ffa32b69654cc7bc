"""The radio field: what surfaces send, point sources, and `RadioField`, their sum."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.field.gateway import GatewayField as GatewayField
    from rf3dgs.field.lit import LitSurface as LitSurface
    from rf3dgs.field.radiance import Surface as Surface
    from rf3dgs.field.radio_field import RadioField as RadioField
    from rf3dgs.field.rays import Rays as Rays
    from rf3dgs.field.sources import PointSources as PointSources
    from rf3dgs.field.transmitter import estimate_transmitter as estimate_transmitter
    from rf3dgs.field.uncertainty import Uncertainty as Uncertainty
    from rf3dgs.field.waves import seen_by_array as seen_by_array

_HOMES = {
    "RadioField": ".radio_field",
    "Surface": ".radiance",
    "LitSurface": ".lit",
    "PointSources": ".sources",
    "Rays": ".rays",
    "Uncertainty": ".uncertainty",
    "estimate_transmitter": ".transmitter",
    "seen_by_array": ".waves",
    "GatewayField": ".gateway",
}
__all__ = [  # noqa: RUF022 (reading order)
    "RadioField",
    "Surface",
    "LitSurface",
    "PointSources",
    "Rays",
    "Uncertainty",
    "estimate_transmitter",
    "seen_by_array",
    "GatewayField",
]
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
