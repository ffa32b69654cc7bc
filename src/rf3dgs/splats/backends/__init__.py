"""The ways to draw Gaussians: the native core on the CPU, gsplat on CUDA; the specification is `splats.reference`."""

from rf3dgs.core.native import native_core, native_failure
from rf3dgs.core.threads import thread_count

__all__ = ["native_core", "native_failure", "thread_count"]
