"""Where paths come from: scenes, the ray tracer, and the camera that photographs the same meshes."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.propagation import sionna as sionna
    from rf3dgs.propagation.cluster import existing_cluster as existing_cluster
    from rf3dgs.propagation.cluster import local_processes as local_processes
    from rf3dgs.propagation.config import PhotoConfig as PhotoConfig
    from rf3dgs.propagation.config import TraceConfig as TraceConfig
    from rf3dgs.propagation.jobs import run_job as run_job
    from rf3dgs.propagation.llvm import find_llvm as find_llvm
    from rf3dgs.propagation.photo_job import PhotoJob as PhotoJob
    from rf3dgs.propagation.photographer import camera_tour as camera_tour
    from rf3dgs.propagation.photographer import render_photos as render_photos
    from rf3dgs.propagation.scene import Scene as Scene
    from rf3dgs.propagation.scene import SceneObject as SceneObject
    from rf3dgs.propagation.scene_files import write_radio_scene as write_radio_scene
    from rf3dgs.propagation.scene_files import write_visual_scene as write_visual_scene
    from rf3dgs.propagation.scenes import scene_of as scene_of
    from rf3dgs.propagation.trace_job import TraceJob as TraceJob

_HOMES = {
    "Scene": ".scene",
    "SceneObject": ".scene",
    "scene_of": ".scenes",
    "write_radio_scene": ".scene_files",
    "write_visual_scene": ".scene_files",
    "TraceConfig": ".config",
    "sionna": ".sionna",
    "PhotoConfig": ".config",
    "camera_tour": ".photographer",
    "render_photos": ".photographer",
    "run_job": ".jobs",
    "TraceJob": ".trace_job",
    "PhotoJob": ".photo_job",
    "local_processes": ".cluster",
    "existing_cluster": ".cluster",
    "find_llvm": ".llvm",
}
__all__ = [  # noqa: RUF022 (reading order)
    "Scene",
    "SceneObject",
    "scene_of",
    "write_radio_scene",
    "write_visual_scene",
    "TraceConfig",
    "sionna",
    "PhotoConfig",
    "camera_tour",
    "render_photos",
    "run_job",
    "TraceJob",
    "PhotoJob",
    "local_processes",
    "existing_cluster",
    "find_llvm",
]
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
