"""When things happen in the visual stage: the published iterations for long runs, shares of the run for short ones."""

from dataclasses import dataclass

from rf3dgs.core.errors import InputError
from rf3dgs.training.config import VisualConfig

PUBLISHED_STEPS = 30_000
LARGEST_HASTE = 4.0
SHORT_DEPTH_WEIGHT = 0.5
FLATTEN_AT = (0.3, 0.5)
LOOK_AGAIN_AT = 0.2
RESERVE = 20  # one in so many Gaussians waits for what the second look finds


@dataclass(frozen=True)
class Schedule:
    """Iterations of the visual stage, all resolved; see `VisualConfig` for their meaning."""

    steps: int
    max_count: int
    double_at: tuple[int, int]
    densify_from: int
    densify_until: int
    densify_every: int
    reset_every: int
    degree_every: int
    degree: int
    lr_means: float
    lr_means_final: float
    haste: float
    """Short runs learn faster: learning rates are multiplied by this, see `VisualConfig`."""
    depth_weight: float
    flatten_at: tuple[int, ...]
    look_again_at: int | None

    @classmethod
    def of(cls, config: VisualConfig) -> "Schedule":
        """The schedule of a configuration; raises `InputError` for counts that make no sense."""
        steps = config.steps
        if steps < 1 or config.max_count < 1 or config.start_count < 1:
            raise InputError(
                f"steps, start_count and max_count must be at least 1; got {steps}, {config.start_count}, "
                f"{config.max_count}"
            )

        def chosen(value: int | None, published: int, share: int) -> int:
            return max(1, min(published, steps // share)) if value is None else max(1, value)

        return cls(
            steps=steps,
            max_count=config.max_count,
            double_at=config.double_at or (min(250, steps // 20), min(500, steps // 10)),
            densify_from=chosen(config.densify_from, 500, 10),
            densify_until=steps // 2 if config.densify_until is None else config.densify_until,
            densify_every=chosen(config.densify_every, 100, 50),
            reset_every=chosen(config.reset_every, 3_000, 1) if steps >= 9_000 or config.reset_every else steps + 1,
            degree_every=chosen(config.degree_every, 1_000, 10),
            degree=config.degree,
            lr_means=config.lr_means,
            lr_means_final=config.lr_means_final,
            depth_weight=SHORT_DEPTH_WEIGHT * max(0.0, 1 - steps / PUBLISHED_STEPS)
            if config.depth_weight is None
            else config.depth_weight,
            flatten_at=tuple(max(1, round(share * steps)) for share in FLATTEN_AT) if config.walls == "flat" else (),
            look_again_at=max(1, round(LOOK_AGAIN_AT * steps)) if config.look_again else None,
            haste=min(LARGEST_HASTE, max(1.0, (PUBLISHED_STEPS / steps) ** 0.5)),
        )

    def shrink_at(self, iteration: int) -> int:
        """How many times smaller than the photograph the picture of an iteration is: 4, 2 or 1."""
        return 4 if iteration < self.double_at[0] else 2 if iteration < self.double_at[1] else 1

    def depth_weight_at(self, iteration: int) -> float:
        """The weight of the sweep's depth in an iteration: it falls to zero while the population grows."""
        return self.depth_weight * max(0.0, 1 - iteration / max(1, self.densify_until))

    def degree_at(self, iteration: int) -> int:
        """The degree of the colour's harmonics in an iteration."""
        return min(self.degree, iteration // self.degree_every)

    def means_rate(self, iteration: int) -> float:
        """The means' learning rate as a share of the scene's extent: exponential between its two ends."""
        share = iteration / max(1, self.steps - 1)
        return self.lr_means * (self.lr_means_final / self.lr_means) ** share

    def densifies_after(self, iteration: int) -> bool:
        """Whether the population changes after an iteration."""
        done = iteration + 1
        return self.densify_from <= done <= self.densify_until and done % self.densify_every == 0

    def flattens_after(self, iteration: int) -> bool:
        """Whether planes are found after an iteration."""
        return iteration + 1 in self.flatten_at

    def looks_again_after(self, iteration: int) -> bool:
        """Whether things that the Gaussians lack are sought after an iteration."""
        return iteration + 1 == self.look_again_at

    def reserve_at(self, iteration: int) -> int:
        """How many Gaussians growth leaves to the second look after an iteration."""
        return self.max_count // RESERVE if self.look_again_at is not None and iteration < self.look_again_at else 0

    def holds_after(self, iteration: int) -> bool:
        """Whether the Gaussians of planes are put back onto them after an iteration: as often as growth, and at the
        end.
        """
        done = iteration + 1
        return bool(self.flatten_at) and (done == self.steps or done % self.densify_every == 0)

    def resets_after(self, iteration: int) -> bool:
        """Whether opacity is reset after an iteration."""
        done = iteration + 1
        return done < self.densify_until and done % self.reset_every == 0

    def prunes_unseen_after(self, iteration: int) -> bool:
        """Whether Gaussians that no photograph shows are removed after an iteration: thrice, and at the end."""
        done = iteration + 1
        span = max(1, self.densify_until - self.densify_from)
        return done == self.steps or done in {self.densify_from + span * part // 3 for part in (1, 2, 3)}
