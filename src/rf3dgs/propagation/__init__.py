"""Where paths come from: scenes, the ray tracer, and the camera that photographs the same meshes.

`coverage.coverage` bears the name of its module and is imported from there.
"""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.propagation import sionna as sionna
    from rf3dgs.propagation.cluster import existing_cluster as existing_cluster
    from rf3dgs.propagation.cluster import local_processes as local_processes
    from rf3dgs.propagation.config import PhotoConfig as PhotoConfig
    from rf3dgs.propagation.config import ReceiverConfig as ReceiverConfig
    from rf3dgs.propagation.config import TraceConfig as TraceConfig
    from rf3dgs.propagation.coverage import Coverage as Coverage
    from rf3dgs.propagation.deepmimo import deepmimo_pairs as deepmimo_pairs
    from rf3dgs.propagation.deepmimo import read_deepmimo as read_deepmimo
    from rf3dgs.propagation.deepmimo_write import write_deepmimo as write_deepmimo
    from rf3dgs.propagation.jobs import run_job as run_job
    from rf3dgs.propagation.llvm import find_llvm as find_llvm
    from rf3dgs.propagation.matlab import write_mat as write_mat
    from rf3dgs.propagation.matlab import write_matlab as write_matlab
    from rf3dgs.propagation.measured import read_sounding as read_sounding
    from rf3dgs.propagation.measured import write_sounding as write_sounding
    from rf3dgs.propagation.photo_job import PhotoJob as PhotoJob
    from rf3dgs.propagation.photographer import render_panorama as render_panorama
    from rf3dgs.propagation.photographer import render_panoramas as render_panoramas
    from rf3dgs.propagation.photographer import render_photos as render_photos
    from rf3dgs.propagation.presets import Preset as Preset
    from rf3dgs.propagation.presets import preset_of as preset_of
    from rf3dgs.propagation.receivers import receivers_of as receivers_of
    from rf3dgs.propagation.room import Slab as Slab
    from rf3dgs.propagation.room import shoebox as shoebox
    from rf3dgs.propagation.scene import Scene as Scene
    from rf3dgs.propagation.scene import SceneObject as SceneObject
    from rf3dgs.propagation.scene_files import write_radio_scene as write_radio_scene
    from rf3dgs.propagation.scene_files import write_visual_scene as write_visual_scene
    from rf3dgs.propagation.scenes import scene_of as scene_of
    from rf3dgs.propagation.sounder import Sounder as Sounder
    from rf3dgs.propagation.sounder import sound as sound
    from rf3dgs.propagation.trace_job import TraceJob as TraceJob
    from rf3dgs.propagation.walks import camera_tour as camera_tour

_HOMES = {
    "Scene": ".scene",
    "SceneObject": ".scene",
    "scene_of": ".scenes",
    "Preset": ".presets",
    "preset_of": ".presets",
    "ReceiverConfig": ".config",
    "receivers_of": ".receivers",
    "write_radio_scene": ".scene_files",
    "write_visual_scene": ".scene_files",
    "TraceConfig": ".config",
    "sionna": ".sionna",
    "shoebox": ".room",
    "Slab": ".room",
    "read_deepmimo": ".deepmimo",
    "deepmimo_pairs": ".deepmimo",
    "write_deepmimo": ".deepmimo_write",
    "write_matlab": ".matlab",
    "write_mat": ".matlab",
    "PhotoConfig": ".config",
    "camera_tour": ".walks",
    "Coverage": ".coverage",
    "render_photos": ".photographer",
    "Sounder": ".sounder",
    "sound": ".sounder",
    "read_sounding": ".measured",
    "write_sounding": ".measured",
    "render_panorama": ".photographer",
    "render_panoramas": ".photographer",
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
    "Preset",
    "preset_of",
    "ReceiverConfig",
    "receivers_of",
    "write_radio_scene",
    "write_visual_scene",
    "TraceConfig",
    "sionna",
    "shoebox",
    "Slab",
    "read_deepmimo",
    "deepmimo_pairs",
    "write_deepmimo",
    "write_matlab",
    "write_mat",
    "PhotoConfig",
    "camera_tour",
    "Coverage",
    "render_photos",
    "Sounder",
    "sound",
    "read_sounding",
    "write_sounding",
    "render_panorama",
    "render_panoramas",
    "run_job",
    "TraceJob",
    "PhotoJob",
    "local_processes",
    "existing_cluster",
    "find_llvm",
]
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
