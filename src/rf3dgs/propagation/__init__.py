"""Where paths come from: scenes, the ray tracer, and the camera that photographs the same meshes.

`coverage.coverage` bears the name of its module and is imported from there.
"""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.propagation import sionna as sionna
    from rf3dgs.propagation.config import PhotoConfig as PhotoConfig
    from rf3dgs.propagation.config import ReceiverConfig as ReceiverConfig
    from rf3dgs.propagation.config import TraceConfig as TraceConfig
    from rf3dgs.propagation.exchange.deepmimo import deepmimo_pairs as deepmimo_pairs
    from rf3dgs.propagation.exchange.deepmimo import read_deepmimo as read_deepmimo
    from rf3dgs.propagation.exchange.deepmimo_write import write_deepmimo as write_deepmimo
    from rf3dgs.propagation.exchange.matlab import write_mat as write_mat
    from rf3dgs.propagation.exchange.matlab import write_matlab as write_matlab
    from rf3dgs.propagation.exchange.measured import read_sounding as read_sounding
    from rf3dgs.propagation.exchange.measured import write_sounding as write_sounding
    from rf3dgs.propagation.jobs.cluster import existing_cluster as existing_cluster
    from rf3dgs.propagation.jobs.cluster import local_processes as local_processes
    from rf3dgs.propagation.jobs.job import run_job as run_job
    from rf3dgs.propagation.jobs.photo_job import PhotoJob as PhotoJob
    from rf3dgs.propagation.jobs.trace_job import TraceJob as TraceJob
    from rf3dgs.propagation.llvm import find_llvm as find_llvm
    from rf3dgs.propagation.photographer import render_panorama as render_panorama
    from rf3dgs.propagation.photographer import render_panoramas as render_panoramas
    from rf3dgs.propagation.photographer import render_photos as render_photos
    from rf3dgs.propagation.room import Slab as Slab
    from rf3dgs.propagation.room import shoebox as shoebox
    from rf3dgs.propagation.sites.coverage import Coverage as Coverage
    from rf3dgs.propagation.sites.presets import Preset as Preset
    from rf3dgs.propagation.sites.presets import preset_of as preset_of
    from rf3dgs.propagation.sites.receivers import receivers_of as receivers_of
    from rf3dgs.propagation.sites.scene import Scene as Scene
    from rf3dgs.propagation.sites.scene import SceneObject as SceneObject
    from rf3dgs.propagation.sites.scene_files import write_radio_scene as write_radio_scene
    from rf3dgs.propagation.sites.scene_files import write_visual_scene as write_visual_scene
    from rf3dgs.propagation.sites.scenes import scene_of as scene_of
    from rf3dgs.propagation.sites.walks import camera_tour as camera_tour
    from rf3dgs.propagation.sounder import Sounder as Sounder
    from rf3dgs.propagation.sounder import sound as sound

_HOMES = {
    "Scene": ".sites.scene",
    "SceneObject": ".sites.scene",
    "scene_of": ".sites.scenes",
    "Preset": ".sites.presets",
    "preset_of": ".sites.presets",
    "ReceiverConfig": ".config",
    "receivers_of": ".sites.receivers",
    "write_radio_scene": ".sites.scene_files",
    "write_visual_scene": ".sites.scene_files",
    "TraceConfig": ".config",
    "sionna": ".sionna",
    "shoebox": ".room",
    "Slab": ".room",
    "read_deepmimo": ".exchange.deepmimo",
    "deepmimo_pairs": ".exchange.deepmimo",
    "write_deepmimo": ".exchange.deepmimo_write",
    "write_matlab": ".exchange.matlab",
    "write_mat": ".exchange.matlab",
    "PhotoConfig": ".config",
    "camera_tour": ".sites.walks",
    "Coverage": ".sites.coverage",
    "render_photos": ".photographer",
    "Sounder": ".sounder",
    "sound": ".sounder",
    "read_sounding": ".exchange.measured",
    "write_sounding": ".exchange.measured",
    "render_panorama": ".photographer",
    "render_panoramas": ".photographer",
    "run_job": ".jobs.job",
    "TraceJob": ".jobs.trace_job",
    "PhotoJob": ".jobs.photo_job",
    "local_processes": ".jobs.cluster",
    "existing_cluster": ".jobs.cluster",
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
