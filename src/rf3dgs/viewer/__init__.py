"""The site in a browser: drag a receiver, see its spectrum and its strongest paths."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.viewer.app import Viewer as Viewer
    from rf3dgs.viewer.app import view as view

__all__ = ["Viewer", "view"]
__getattr__, __dir__ = lazy_names(__name__, {"view": ".app", "Viewer": ".app"})
