"""The scenes of the table: where the transmitter and the receivers are, and which surfaces the geometry covers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.progress import Progress
from rf3dgs.propagation.config import ReceiverConfig, TraceConfig
from rf3dgs.propagation.jobs.job import run_job
from rf3dgs.propagation.jobs.trace_job import TraceJob
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.presets import preset_of
from rf3dgs.propagation.sites.receivers import receivers_of
from rf3dgs.propagation.sites.scene import Scene, SceneObject, without_looks
from rf3dgs.propagation.sites.scenes import scene_of
from rf3dgs.propagation.sites.shapes import ball, box, prism

MOVED: Mapping[str, tuple[float, float]] = {
    "desk-front": (-5.5, -0.2),
    "desk-side": (-5.5, -0.2),
    "desk-top": (-5.5, -0.2),
    "bench-3": (3.5, 0.0),
    "crate-1": (-6.0, 1.5),
    "crate-3": (-6.0, 1.5),
    "partition": (-3.5, -4.0),
    "table": (1.5, 2.0),
    "table-foot": (1.5, 2.0),
    "totem": (-3.0, 1.0),
}
"""How far [m] the furniture of "lobby-moved" stands from where it was."""

BEFORE = {"lobby-moved": "lobby-before"}
"""What a scene was before things moved in it; both have the same receivers."""


@dataclass(frozen=True)
class Setting:
    """A scene under a preset of `rf3dgs trace`; its site is looked up by name."""

    name: str
    preset: str

    def __post_init__(self) -> None:
        if self.name not in SITES:
            raise InputError(f"the scenes of the table are {', '.join(SITES)}; got {self.name!r}")
        preset_of(self.preset)

    @property
    def site(self) -> "Site":
        return SITES[self.name]

    @property
    def photographs(self) -> str:
        """The shipped dataset whose photographs show this scene as it was before anything moved; "" for none."""
        return "lobby" if self.name.startswith("lobby") else ""

    def scene(self) -> Scene:
        """The scene itself, without what the preset changes: what geometry is taken from."""
        return self.site.make()

    def receivers(self, count: int) -> Pose:
        """The first `count` receivers, whatever the count; the same ones on every run."""
        scene = self.scene()
        if self.name in (*BEFORE, *BEFORE.values()):
            here, there = lobby().receivers(2 * count, 0), _lobby_moved()
            return _taken(here, there.free(here.position, 0.35), count, there)
        if not self.site.roofed:
            return receivers_of(scene, ReceiverConfig(count=count))
        drawn = scene.receivers(4 * count, 0)
        return _taken(drawn, ~under_a_roof(drawn.position, *scene.mesh()[:2]), count, scene)


@dataclass(frozen=True)
class Site:
    """How a scene is made, and what suits it.

    preset: unless another is named. receivers: how many, of which `held` (test, region, validation, near) are held out
    with a `buffer` [m] round regions. roofed: receivers must be looked for outside buildings, which are not closed.
    around: geometry is cut off so far [m] from where receivers may be, and faces that nobody sees are left out.
    """

    make: Callable[[], Scene]
    preset: str
    receivers: int = 240
    held: tuple[int, int, int, int] = (50, 50, 20, 20)
    buffer: float = 0.3
    roofed: bool = False
    around: float | None = None


def paths_of(setting: Setting, folder: Path, rx: Pose, config: TraceConfig, progress: Progress) -> Path:
    """The folder of paths to receivers `rx` `[rx]`, as `rf3dgs trace` writes it; a killed run goes on."""
    scene, config = preset_of(setting.preset).applied(setting.scene(), config)
    job = TraceJob(
        scene=without_looks(scene),
        tx=scene.tx,
        rx=rx,
        frequency=config.frequency or scene.frequency,
        config=config,
        rule={"site": setting.name},
    )
    run_job(job, folder, progress=progress)
    return folder


def under_a_roof(points: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    """True `[n]` for points `[n, 3]` with a face of the mesh straight above them: inside a building, or under it."""
    a, b, c = vertices[faces].double().unbind(1)
    covered = torch.zeros(len(points), dtype=torch.bool)
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    flat = area.abs() > 1e-9  # an upright face covers nobody
    a, b, c, area = a[flat], b[flat], c[flat], area[flat]
    for place, point in enumerate(points.double()):
        u = ((point[0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (point[1] - a[:, 1]) * (c[:, 0] - a[:, 0])) / area
        v = ((b[:, 0] - a[:, 0]) * (point[1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (point[0] - a[:, 0])) / area
        above = a[:, 2] + u * (b - a)[:, 2] + v * (c - a)[:, 2] > point[2]
        covered[place] = bool(((u >= 0) & (v >= 0) & (u + v <= 1) & above).any())
    return covered


def _taken(drawn: Pose, good: Tensor, count: int, scene: Scene) -> Pose:
    place = good.nonzero().squeeze(-1)
    if len(place) < count:
        raise InputError(f"scene {scene.name!r} has room for {len(place)} of {count} receivers; ask for fewer")
    return drawn[place[:count]]


def _lobby_moved() -> Scene:
    """The lobby with ten things elsewhere; walls, columns and the transmitter stay."""
    scene = lobby()
    objects = []
    for item in scene.objects:
        x, y = MOVED.get(item.name, (0.0, 0.0))
        objects.append(replace(item, vertices=item.vertices + torch.tensor([x, y, 0.0])))
    return replace(scene, name="lobby-moved", objects=tuple(objects))


def _round_room() -> Scene:
    """A room of 8 x 7 x 3 m with a cylinder of metal and a sphere of wood: mirrors that are not flat."""
    shell = box((0.0, 0.0, 0.0), (8.0, 7.0, 3.0))
    things = {
        "room": ((shell[0], shell[1].flip(1), shell[2]), "concrete", 0.6, False),
        "cylinder": (prism((3.0, 4.6), 0.5, 0.0, 3.0, 64), "metal", 0.3, True),
        "sphere": (ball((5.4, 2.6, 1.1), (0.7, 0.7, 0.7), around=48, rows=24), "wood", 0.5, True),
    }
    objects = tuple(
        SceneObject(name, mesh[0], mesh[1], material, scattering, solid=solid)
        for name, (mesh, material, scattering, solid) in things.items()
    )
    return Scene(
        name="round-room",
        objects=objects,
        tx=Pose.look_at((0.7, 0.8, 2.4), (5.0, 4.5, 1.2)),
        bounds=((0.0, 0.0, 0.0), (8.0, 7.0, 3.0)),
        rx_bounds=((0.4, 0.4, 1.0), (7.6, 6.6, 2.0)),
        camera_bounds=((0.6, 0.6, 0.9), (7.4, 6.4, 2.2)),
        frequency=60e9,
    )


def _canyon() -> Scene:
    """Sionna's street with cars: the transmitter on a mast in the street, people at 1.5 m."""
    scene = scene_of("simple_street_canyon_with_cars")
    return replace(
        scene,
        tx=Pose.look_at((-32.0, 0.5, 12.0), (0.0, 0.0, 1.5)),
        rx_bounds=((-28.0, -8.5, 1.5), (45.0, 9.5, 1.5)),
    )


def _munich() -> Scene:
    """The streets round Munich's Frauenkirche within 75 m of the transmitter's mast, people at 1.5 m."""
    scene = scene_of("munich")
    return replace(
        scene,
        tx=Pose.look_at((8.5, 21.0, 27.0), (45.0, 90.0, 1.5)),
        rx_bounds=((-30.0, -15.0, 1.5), (90.0, 110.0, 1.5)),
    )


SITES: Mapping[str, Site] = {
    "lobby": Site(lobby, "realistic", receivers=480, held=(100, 100, 40, 40)),
    "lobby-moved": Site(_lobby_moved, "realistic"),
    "lobby-before": Site(lobby, "realistic"),
    "round-room": Site(_round_room, "realistic"),
    "simple_street_canyon_with_cars": Site(_canyon, "28ghz", buffer=2.0, around=60.0),
    "munich": Site(_munich, "28ghz", buffer=3.0, roofed=True, around=80.0),
}
