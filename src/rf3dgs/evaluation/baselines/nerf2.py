"""NeRF2 as a predictor: fitted to training pictures, asked for pictures at other poses.

In the paper the receiving array stands still and the transmitter, a tag, moves. Here the transmitter stands still and
the receiver moves. Rays start at the receiver in both; what changes from picture to picture is the rays' origin instead
of the transmitter's position, which the radiance network still gets, as a constant.
"""

import time
from collections.abc import Callable

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError, TrainingError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.core.units import db_from_power, power_from_db
from rf3dgs.evaluation.baselines.nerf2_config import Nerf2Config
from rf3dgs.evaluation.baselines.nerf2_network import Nerf2Network, received
from rf3dgs.evaluation.metrics import pixel_weight
from rf3dgs.spectra.codec import DbWindow, PerViewLinear
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra

Entry = tuple[int, float, float, float | None]
"""Iterations done, seconds since the start, mean loss since the last entry, what `on_step` answered."""
OnStep = Callable[[int, "Nerf2"], float | None]


class Nerf2:
    """A fitted (or not yet fitted) NeRF2: `render(pose, grid)` answers with the power, without delay or departure.

    A picture's own scale is lost in "linear" training. What comes back is power relative to the strongest direction
    times one level for all poses, the mean of the training pictures' peaks [dB]: levels between positions mean nothing.
    """

    name = "NeRF2"

    def __init__(self, train: Spectrum, config: Nerf2Config, window: DbWindow) -> None:
        if not train.pose.batch_shape or len(train) == 0:
            raise InputError("NeRF2 needs training spectra with a pose axis and at least one picture")
        if not bool(torch.isfinite(train.power).all()) or not bool((train.power.amax((-2, -1)) > 0).all()):
            raise InputError("NeRF2 needs pictures with finite power, some in each; remove those that have none")
        self.config, self.window, self.history = config, window, list[Entry]()
        self.frequency, self.instrument, self.tx = train.frequency, train.instrument, train.tx
        self.peak_db = float(db_from_power(train.power.amax((-2, -1))).mean())
        places = train.pose.position if train.tx is None else torch.cat((train.pose.position, train.tx.position[None]))
        low, high = places.amin(0), places.amax(0)
        self.centre = (low + high) / 2
        self.far = float((high - low).norm()) if config.far is None else config.far
        if self.far < 1e-3:
            raise InputError("one position and no transmitter do not tell how far rays go; give far in metres")
        self.device = _device(config)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.network = Nerf2Network(config).to(self.device)

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The spectrum on `grid` at one pose, or `[n, row, col]` at n poses."""
        if pose.batch_shape:
            return stack_spectra([self.render(pose[index], grid) for index in range(len(pose))])
        directions = pose.to_world(grid.directions).reshape(-1, 3)
        with torch.no_grad():
            parts = [self.values(pose.position.expand_as(part), part) for part in directions.split(self.config.chunk)]
        value = torch.cat(parts).reshape(grid.shape).cpu()
        if self.config.target == "linear":
            power = value * power_from_db(torch.tensor(self.peak_db))
        else:
            power = self.window.decode(value.clamp(0.0, 1.0))
        return Spectrum(power, grid, pose, self.frequency, self.instrument, self.name, tx=self.tx)

    def values(self, origins: Tensor, directions: Tensor) -> Tensor:
        """The pictures' values `[ray]`, |sum of signals|, of rays from `origins` to `directions`, both `[ray, 3]`."""
        count = self.config.samples
        along = (torch.arange(count, device=self.device) + 0.5) / count
        start = ((origins - self.centre) / self.far).to(self.device)
        source = torch.zeros(3) if self.tx is None else (self.tx.position - self.centre) / self.far
        directions = directions.to(self.device)
        points = start[:, None] + along[:, None] * directions[:, None]
        attenuation, signal = self.network(points, directions, source.to(self.device))
        return received(attenuation, signal, 1.0 / count).abs()


def fit_nerf2(
    train: Spectrum,
    config: Nerf2Config,
    window: DbWindow,
    progress: Progress | None = None,
    on_step: OnStep | None = None,
) -> Nerf2:
    """NeRF2 trained on the pictures `[picture, row, col]` of `train`, spheres or pinholes.

    Rays are drawn from all pictures; on a sphere directions are as likely as their solid angle. The loss is the mean
    square error of the pictures' values: relative power, or places in `window`. `on_step(done, model)` is called at
    every entry of the history; its answer, a held-out score or None, is kept there. TrainingError where the loss is no
    longer finite.
    """
    model = Nerf2(train, config, window)
    progress = Silent() if progress is None else progress
    generator = torch.Generator().manual_seed(config.seed)
    encoded = (PerViewLinear() if config.target == "linear" else window).encode(train.power).flatten(1)
    share = pixel_weight(train.grid).flatten().double().cumsum(0)
    local, turn = train.grid.directions.reshape(-1, 3), train.pose.world_from_device
    optimizer = torch.optim.Adam(model.network.parameters(), config.lr, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps, config.lr_final)
    progress.start("NeRF2", config.steps)
    began, losses = time.perf_counter(), list[Tensor]()
    for done in range(1, config.steps + 1):
        view = torch.randint(len(train), (config.rays,), generator=generator)
        drawn = torch.rand(config.rays, generator=generator, dtype=torch.float64)
        pixel = torch.searchsorted(share, drawn).clamp_max(len(share) - 1)
        directions = (turn[view] @ local[pixel][..., None])[..., 0]
        value = model.values(train.pose.position[view], directions)
        loss = torch.nn.functional.mse_loss(value, encoded[view, pixel].to(model.device))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.detach())
        if done % config.report_every == 0 or done == config.steps:
            mean = float(torch.stack(losses).mean())
            if not mean < float("inf"):
                raise TrainingError(f"the loss is no longer finite after {done} steps; try a smaller lr")
            seconds, losses = time.perf_counter() - began, []
            model.history.append((done, seconds, mean, None if on_step is None else on_step(done, model)))
            progress.update(done, f"loss {mean:.4f}")
    progress.finish()
    return model


def _device(config: Nerf2Config) -> torch.device:
    there = torch.cuda.is_available()
    if config.device == "cuda" and not there:
        raise InputError("the device is cuda and torch finds none; use auto or cpu")
    return torch.device("cuda" if there and config.device != "cpu" else "cpu")
