"""A conditional GAN: a network that has seen training pictures draws the picture of any pose.

What the paper compares with as a black box (its Fig. 8). It knows nothing of walls or waves.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, l1_loss

from rf3dgs.core.errors import InputError, TrainingError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, sample_grid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.evaluation.baselines.cgan_config import LEAST_BATCH, CganConfig
from rf3dgs.evaluation.baselines.cgan_nets import Discriminator, Generator, PoseCode
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum, stack_spectra

SMALLEST = 8  # pixels on a picture's shorter side
RECORDS = 200  # of a training curve


class Step(NamedTuple):
    """One point of the training curve: means over the steps since the point before."""

    step: int
    """Steps done."""
    seconds: float
    """Since the fit began, by the clock."""
    loss: float
    """The generator's: weighted verdict plus weighted mean absolute error."""
    score: float | None
    """What `on_step` answered; None without it."""
    discriminator: float | None
    """The discriminator's, ln 2 where it only guesses; None without one."""
    l1: float
    """Mean absolute error of pictures between 0 and 1."""


@dataclass(frozen=True, eq=False)
class Cgan:
    """A trained generator; `history` is its training curve."""

    generator: Generator
    code: PoseCode
    grid: DirectionGrid
    window: DbWindow
    frequency: float
    instrument: Instrument
    tx: Pose | None
    history: tuple[Step, ...] = ()

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The spectrum on `grid` at one pose, or `[n, row, col]` at n poses; no delay and no departure.

        The picture is drawn on the training grid; another grid's directions are interpolated in it, in dB. InputError
        where they are outside it. Power is never below the window's floor.
        """
        if pose.batch_shape:
            return stack_spectra([self.render(pose[index], grid) for index in range(len(pose))])
        same = self.grid.same_as(grid)
        if not same and not bool(self.grid.pixel_of(grid.directions)[1].all()):
            raise InputError(
                "a GAN trained on pinhole pictures draws what lies in them; the asked grid looks beyond. Ask for a "
                "grid inside the training pictures, or train on spheres"
            )
        picture = self._drawn(pose)
        if not same:
            picture = sample_grid(picture[..., None], self.grid, grid.directions)[..., 0]
        power = self.window.decode((picture + 1) / 2)
        return Spectrum(power, grid, pose, self.frequency, self.instrument, "cgan", tx=self.tx)

    def _drawn(self, pose: Pose) -> Tensor:
        """The picture `[row, col]` of the training grid at one pose, -1 to 1."""
        device, training = next(self.generator.parameters()).device, self.generator.training
        self.generator.eval()
        with torch.no_grad():
            picture = self.generator(self.code.picture(pose.flat(), self.grid).to(device))[0, 0].cpu()
        self.generator.train(training)
        return picture


OnStep = Callable[[int, Cgan], float | None]


def fit_cgan(
    train: Spectrum,
    config: CganConfig,
    window: DbWindow,
    progress: Progress | None = None,
    on_step: OnStep | None = None,
) -> Cgan:
    """Train on pictures `[picture, row, col]`, pinholes or spheres of 8 pixels or more each way, in `window`.

    Pictures of one position count one by one. Delay and departure are not learned. `on_step(done, cgan)` is called at
    every record of the curve; its answer, a held-out score or None, is kept there. InputError for spectra without a
    pose axis or on a list of directions; TrainingError where the loss is no longer finite.
    """
    _check(train)
    device = _device(config)
    position = train.pose.position
    code = PoseCode(position.amin(0), position.amax(0), config.octaves)
    with torch.random.fork_rng():
        torch.manual_seed(config.seed)
        generator = Generator(code.channels, config, train.grid).to(device)
        cgan = Cgan(generator, code, train.grid, window, train.frequency, train.instrument, train.tx)
        history = _train(cgan, train, config, Silent() if progress is None else progress, on_step)
    generator.eval()
    return replace(cgan, history=history)


def _train(
    cgan: Cgan, train: Spectrum, config: CganConfig, progress: Progress, on_step: OnStep | None
) -> tuple[Step, ...]:
    """Train the generator in place; what returns is the curve."""
    generator, code = cgan.generator, cgan.code
    device = next(generator.parameters()).device
    targets = (2 * cgan.window.encode(train.power) - 1)[:, None].to(device)
    batch = max(LEAST_BATCH, config.pixels // targets[0].numel())
    critic, judging = None, None
    if config.adversarial > 0:
        critic = Discriminator(code.channels, config, train.grid).to(device)
        judging = torch.optim.Adam(critic.parameters(), config.lr, config.betas)
    drawing = torch.optim.Adam(generator.parameters(), config.lr, config.betas)
    every, began = max(1, config.steps // RECORDS), time.perf_counter()
    losses: list[Tensor] = []
    curve: list[Step] = []
    progress.start("fit cgan", config.steps)
    for step, chosen in enumerate(picture_order(len(targets), batch, config.steps, config.seed), start=1):
        rate = config.lr * min(1.0, 2 * (1 - (step - 1) / config.steps))
        condition, truth = code.picture(train.pose[chosen], train.grid).to(device), targets[chosen]
        drawn = generator(condition)
        l1 = l1_loss(drawn, truth)
        loss, verdict = config.l1 * l1, None
        if critic is not None and judging is not None:
            real, fake = critic(condition, truth), critic(condition, drawn.detach())
            verdict = 0.5 * (_told(real, 1.0) + _told(fake, 0.0))
            _step(judging, verdict, rate)
            critic.requires_grad_(False)
            loss = loss + config.adversarial * _told(critic(condition, drawn), 1.0)
            critic.requires_grad_(True)
        _step(drawing, loss, rate)
        losses.append(torch.stack((loss, l1 / 2, l1 if verdict is None else verdict)).detach())
        if step % every == 0 or step == config.steps:
            mean, losses = torch.stack(losses).mean(0).tolist(), []
            if not mean[0] < float("inf"):
                raise TrainingError(f"the GAN's loss is {mean[0]} at step {step}; lower lr, which is {config.lr}")
            seconds, judged = time.perf_counter() - began, None if verdict is None else mean[2]
            score = None if on_step is None else on_step(step, replace(cgan, history=tuple(curve)))
            curve.append(Step(step, seconds, mean[0], score, judged, mean[1]))
            progress.update(step, f"L1 {mean[1]:.4f}")
    progress.finish()
    return tuple(curve)


def picture_order(count: int, batch: int, steps: int, seed: int) -> Iterator[Tensor]:
    """The pictures of each step, `[min(batch, count)]`: all of them shuffled, then all shuffled anew, and so on."""
    random = torch.Generator().manual_seed(seed)
    queue = torch.zeros(0, dtype=torch.long)
    batch = min(batch, count)
    for _ in range(steps):
        if len(queue) < batch:
            queue = torch.cat((queue, torch.randperm(count, generator=random)))
        yield queue[:batch]
        queue = queue[batch:]


def _told(logits: Tensor, answer: float) -> Tensor:
    """Cross-entropy of the patches' verdicts, were `answer` (1 true, 0 drawn) right for all of them."""
    return binary_cross_entropy_with_logits(logits, torch.full_like(logits, answer))


def _step(optimizer: torch.optim.Optimizer, loss: Tensor, rate: float) -> None:
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def _device(config: CganConfig) -> torch.device:
    if config.device == "cuda" and not torch.cuda.is_available():
        raise InputError('device is "cuda" but there is no CUDA device; use device="auto" or "cpu"')
    wanted = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(wanted if config.device == "auto" else config.device)


def _check(train: Spectrum) -> None:
    if not train.pose.batch_shape or len(train) == 0:
        raise InputError("a GAN needs training spectra with a pose axis and at least one picture")
    if train.grid.kind == "list" or min(train.grid.shape) < SMALLEST:
        kind = f"{train.grid.kind} {train.grid.width}x{train.grid.height}"
        raise InputError(
            f"a GAN learns pinhole or equirectangular pictures of {SMALLEST} pixels or more each way; got {kind}"
        )
