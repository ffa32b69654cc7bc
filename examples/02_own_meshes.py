"""# From a folder of your own meshes to a dataset

A room drawn elsewhere (here: four boxes) is exported as PLY, OBJ or GLB files into one folder. A table beside them says
what the objects are made of and where transmitter and receivers are. The folder is then a scene: it is traced,
photographed and written as a dataset that `rf3dgs fit` takes. Needs `pip install "rf3dgs[trace,mesh]"` and LLVM.

    python examples/02_own_meshes.py
"""

import tempfile
from pathlib import Path

import trimesh

import rf3dgs
from rf3dgs.cli.chain import make_dataset
from rf3dgs.core.progress import Silent
from rf3dgs.propagation import PhotoConfig, ReceiverConfig, TraceConfig, receivers_of, scene_of

folder = Path(tempfile.mkdtemp()) / "office"
folder.mkdir()

# What a modelling program would export. A room's faces look inwards, those of things in it outwards.
room = trimesh.creation.box(bounds=[(0, 0, 0), (6, 5, 3)])
room.invert()
parts = {
    "room": room,
    "desk": trimesh.creation.box(bounds=[(3.8, 0.3, 0.7), (5.4, 1.1, 0.75)]),
    "cupboard": trimesh.creation.box(bounds=[(0.05, 3.8, 0), (0.6, 4.9, 2.0)]),
    "pillar": trimesh.creation.cylinder(radius=0.2, segment=[(3.0, 2.5, 0.0), (3.0, 2.5, 3.0)], sections=12),
}
for name, mesh in parts.items():
    mesh.export(folder / f"{name}.ply")

(folder / "materials.toml").write_text("""
[site]
frequency_ghz = 28
tx = [0.5, 0.5, 2.6]
look_at = [4, 3, 1]
rx_low = [0.6, 0.6, 1.0]
rx_high = [5.4, 4.4, 1.8]

[objects.cupboard]
material = "metal"
colour = [0.5, 0.5, 0.55]

[objects.pillar]                # a material of your own
permittivity = 5.2
conductivity = 0.6
thickness = 0.2
scattering = 0.5
colour = [0.7, 0.6, 0.5]

[objects.desk]
material = "wood"

[objects."*"]                   # everything else
material = "plasterboard"
thickness = 0.15
""")

scene = scene_of(folder)
print(f"{scene.name}: {len(scene.objects)} objects at {scene.frequency / 1e9:g} GHz")
print(f"a grid of 1 m has {len(receivers_of(scene, ReceiverConfig(kind='grid', spacing=1.0)))} free places")

# Small numbers, so that this takes half a minute; a dataset for training has 300,000 rays and many more of the rest.
dataset = make_dataset(
    scene,
    folder.parent / "dataset",
    rf3dgs.equirect_grid(90, 45),
    receivers=12,
    photos=3,
    trace=TraceConfig(rays=20_000, depth=2),
    photo=PhotoConfig(width=80, height=60, samples=16, bounces=3),
    seed=0,
    progress=Silent(),
)
assert len(dataset.photos) == 3
print(dataset)
