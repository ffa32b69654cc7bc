"""The native core as the layers of splatting know it; see `rf3dgs.core.native`."""

from rf3dgs.core.native import native_core, native_failure, thread_count

__all__ = ["native_core", "native_failure", "thread_count"]
