"""`eval`: how good a field is on spectra it has not seen, beside copies of the nearest measurements."""

import json
from dataclasses import dataclass
from pathlib import Path

import tyro

from rf3dgs.cli.show import console, out
from rf3dgs.core.errors import InputError


@dataclass(frozen=True)
class Eval:
    """Score a field on a dataset's held-out positions and write the report."""

    field: tyro.conf.Positional[str]
    """A .field folder, or "lobby" for the one that ships with the package."""
    dataset: tyro.conf.Positional[str]
    """A dataset folder, or "lobby" for the one that ships with the package."""
    out: Path = Path("report.html")
    """The report to write: one self-contained HTML file."""
    geometry: Path | None = None
    """The geometry's .ply, to show photographs beside their renderings."""
    read_test: bool = False
    """Open the sealed test positions and the held-out region; each read is logged in the dataset's folder. Without it
    the validation positions are scored."""
    json_out: Path | None = None
    """Also write every number as JSON."""

    def run(self) -> int:
        """Evaluate, print the table, write the report."""
        from rf3dgs.cli.chain import evaluate_parts, report_inputs
        from rf3dgs.cli.facts import open_dataset, open_field
        from rf3dgs.core.files import write_whole
        from rf3dgs.evaluation.report import write_report
        from rf3dgs.evaluation.table import format_table
        from rf3dgs.splats.ply import read_ply

        field, dataset = open_field(self.field), open_dataset(self.dataset)
        geometry = read_ply(self.geometry) if self.geometry else None
        train = dataset.train.spectra
        if train is None:
            raise InputError(f"{self.dataset} has no spectra to evaluate on")
        if self.read_test:
            reason = f"rf3dgs eval {Path(self.field).name}"
            parts = {"random": dataset.open_test(reason), "region": dataset.open_test(reason, "region")}
        else:
            parts = {"validation": dataset.validation}
        evaluations = evaluate_parts(field, train, parts, console(), seed=0)
        if not evaluations:
            raise InputError(f"{self.dataset} has no held-out positions of this kind; try --read-test")
        command = f"rf3dgs eval {Path(self.field).name} {Path(self.dataset).name}{' --read-test' * self.read_test}"
        inputs = report_inputs(
            f"Radio radiance field: {Path(self.field).stem}",
            *(field, dataset, parts, evaluations),
            geometry=geometry,
            command=command,
        )
        write_report(self.out, inputs)
        if self.json_out is not None:
            content = {name: evaluation.as_dict() for name, evaluation in evaluations.items()}
            write_whole(self.json_out, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
        out(format_table(evaluations))
        out(f"report: {self.out}")
        return 0
