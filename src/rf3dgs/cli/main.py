"""`rf3dgs`: finds the command, runs it, and turns an error of ours into one sentence and an exit status."""

import gc
import logging
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from rf3dgs import __version__
from rf3dgs.cli.ask import Csi, Render, View
from rf3dgs.cli.check import Doctor, Info, Validate
from rf3dgs.cli.demo import Demo
from rf3dgs.cli.exchange import Export, Import
from rf3dgs.cli.fit import Fit, FitGeometry, FitRadio
from rf3dgs.cli.geometry import CheckGeometry
from rf3dgs.cli.judge import Eval
from rf3dgs.cli.make import MakePhotos, Trace
from rf3dgs.cli.show import complain, out
from rf3dgs.cli.spectra import MakeSpectra
from rf3dgs.core.errors import RfError

name = tyro.conf.subcommand
Command = (
    Annotated[Demo, name("demo")]
    | Annotated[Trace, name("trace")]
    | Annotated[MakePhotos, name("photos")]
    | Annotated[MakeSpectra, name("spectra")]
    | Annotated[Import, name("import")]
    | Annotated[Export, name("export")]
    | Annotated[Fit, name("fit")]
    | Annotated[FitGeometry, name("fit-geometry")]
    | Annotated[CheckGeometry, name("check-geometry")]
    | Annotated[FitRadio, name("fit-radio")]
    | Annotated[Render, name("render")]
    | Annotated[Csi, name("csi")]
    | Annotated[Eval, name("eval")]
    | Annotated[View, name("view")]
    | Annotated[Info, name("info")]
    | Annotated[Validate, name("validate")]
    | Annotated[Doctor, name("doctor")]
)

ABOUT = """rf3dgs: radio radiance fields. From photographs of a site and a few tens of radio spectra to a model that
answers, at any receiver pose, which paths arrive from where, how strong, how late, and how they left the transmitter.
`rf3dgs demo` shows the whole story on the built-in lobby."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status: 0 good, 1 found faults, 2 an error, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments in (["--version"], ["version"]):
        out(f"rf3dgs {__version__}")
        return 0
    # torch's idle OpenMP threads spin for milliseconds after every operation; on a shared or small machine that costs
    # more than the work. The variable is read when torch is imported, which no line above does.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    level = os.environ.get("RF3DGS_LOG", "WARNING").upper()
    if level not in logging.getLevelNamesMapping():
        complain(f"RF3DGS_LOG must be DEBUG, INFO, WARNING or ERROR; got {level!r}")
        return 2
    logging.basicConfig(level=level, format="%(name)s: %(message)s")
    try:
        command = tyro.cli(
            Command,  # type: ignore[arg-type]
            prog="rf3dgs",
            description=ABOUT,
            args=arguments,
            config=(tyro.conf.ConsolidateSubcommandArgs,),
        )
        return command.run()
    except RfError as error:
        complain(str(error))
        return 2
    except KeyboardInterrupt:
        complain("interrupted; the same command again goes on with what takes long: tracing, photographs, training")
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        complain(f"{where}{error.strerror or error}; check the name, its folder and free space")
        return 2


def entry() -> None:
    """The process of the command line: `main`, started and ended without the second that Python would add.

    Importing torch makes hundreds of thousands of objects, which the default thresholds would collect over and over;
    taking them down again one by one saves nothing, because every file is written and closed when `main` returns.
    """
    gc.set_threshold(100_000, 20, 20)
    try:
        status = main()
    except SystemExit as stop:  # tyro ends so after --help and after a wrong argument
        status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
