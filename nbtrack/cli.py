"""The command line: a thin face over the functions that the notebooks call."""

import argparse
import os
import sys
from collections.abc import Sequence as Texts

from nbtrack.cli_data import add_data, add_format
from nbtrack.cli_options import (
    Parser,
    a_path,
    a_seed,
    add_device,
    add_field,
    add_preset,
    field_of,
    preset_of,
    set_device,
    words_of,
)
from nbtrack.core.errors import ConfigError, NbtrackError


def main(arguments: Texts[str] | None = None) -> int:
    """Run a command; returns the exit status: 0, or 2 after a user's mistake."""
    try:
        options = _parser().parse_args(arguments)
        set_device(options)
        options.command(options)
    except NbtrackError as error:
        print(f"nbtrack: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except OSError as error:  # a disk that is full or read-only, a file where a folder should be
        where = error.filename2 or error.filename or "the output"
        print(
            f"nbtrack: {where}: {error.strerror or error}; what was finished is kept: make room or "
            "choose another place, and run the same command again",
            file=sys.stderr,
        )
        return 2
    except KeyboardInterrupt:
        print("nbtrack: interrupted; run the same command again to go on", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="nbtrack", description="RGB-D camera tracking in neural scenes.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
    _add_map(commands)
    _add_track(commands)
    _add_export(commands)
    _add_tables(commands)
    _add_notebooks(commands)
    add_data(commands, Parser)
    _add_bench(commands)
    return parser


def _add_map(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("map", help="fit a field to a sequence with known poses")
    parser.add_argument("sequence", help="a folder, or the name of a room or dataset scene")
    add_format(parser)
    add_field(parser)
    parser.add_argument("--frames", default=":", help="Python slice of frames, A:B:S")
    parser.add_argument("--seed", type=a_seed, default=0)
    parser.add_argument("--out", type=a_path, help="folder for the map (default: in the cache)")
    add_device(parser)
    add_preset(parser)
    parser.set_defaults(command=_map)


def _map(options: argparse.Namespace) -> None:
    from nbtrack.experiments.commands import map_command

    map_command(
        options.sequence, field_of(options), preset_of(options), options.frames, options.seed,
        options.out, options.format,
    )  # fmt: skip


def _add_track(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("track", help="track a camera; maps first where no map fits")
    parser.add_argument("sequence", help="a folder, or the name of a room or dataset scene")
    add_format(parser)
    add_field(parser, required=False)
    parser.add_argument("--tracker", required=True, help="vr, sdf, lm or another")
    budget = parser.add_mutually_exclusive_group(required=True)
    budget.add_argument("--rate", type=float, metavar="HZ", help="frames a second, by the clock")
    budget.add_argument("--steps", type=float, metavar="N", help="optimisation steps a frame")
    parser.add_argument("--pixels", type=int, metavar="N", help="pixels a step")
    parser.add_argument(
        "--bake", type=float, metavar="METRES",
        help="ask the field on a grid of such cells instead of the network, for example 0.04",
    )  # fmt: skip
    parser.add_argument("--map-frames", help="Python slice of frames to map (default: all)")
    parser.add_argument(
        "--map-from", type=a_path, metavar="MAP",
        help="track in this map, of another recording of the room: a folder or a map file",
    )  # fmt: skip
    parser.add_argument("--frames", default=":", help="Python slice of frames to track")
    parser.add_argument("--seed", type=a_seed, default=0)
    parser.add_argument("--out", type=a_path, help="folder for the results (default: in the cache)")
    add_device(parser)
    add_preset(parser)
    parser.set_defaults(command=_track)


def _track(options: argparse.Namespace) -> None:
    from nbtrack.experiments.commands import track_command

    if options.pixels is not None:
        options.settings.append(f"tracking.{options.tracker}.n_pixels={options.pixels}")
    if options.bake is not None:
        options.settings.append(f"tracking.{options.tracker}.bake_voxel={options.bake}")
    if options.field is None and options.map_from is None:
        raise ConfigError("track needs --field, or --map-from with a map that knows its own")
    if options.field is None and options.supervision is not None:
        raise ConfigError("--supervision belongs to --field: name that too, or leave both out")
    track_command(
        options.sequence, field_of(options) if options.field else None, options.tracker,
        preset_of(options), steps=options.steps, rate_hz=options.rate,
        map_frames=options.map_frames, frames=options.frames, seed=options.seed, out=options.out,
        map_from=options.map_from, format=options.format,
    )  # fmt: skip


def _add_export(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("export", help="a run's trajectory or a map in another format")
    parser.add_argument("source", type=a_path, help="folder of a run or a map, or a map file")
    parser.add_argument(
        "--to", required=True, metavar="FORMAT",
        help="tum, kitti: trajectory; ply, glb: coloured mesh; map: one file that opens anywhere",
    )  # fmt: skip
    parser.add_argument("out", type=a_path, help="file to write")
    parser.set_defaults(command=_export)


def _export(options: argparse.Namespace) -> None:
    from nbtrack.experiments.commands import export_command

    export_command(options.source, options.to, options.out)


def _add_tables(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("tables", help="the paper's tables, and one beyond, CSV and LaTeX")
    parser.add_argument(
        "--budget", default="steps",
        help="steps: the paper's step counts (default); clock: this machine's own speed; both",
    )  # fmt: skip
    parser.add_argument("--scenes", metavar="A,B", help="only these scenes of the preset's kind")
    parser.add_argument(
        "--trackers", metavar="A,B", default="", help="rows (default: the paper's, vr,sdf)"
    )
    parser.add_argument(
        "--beyond", action="store_true",
        help="Table III instead: the paper's trackers and ours, at 30 Hz too",
    )  # fmt: skip
    parser.add_argument(
        "--seeds", type=int, default=1, metavar="K", help="K maps and runs a cell: mean ± deviation"
    )
    parser.add_argument(
        "--workers", type=int, metavar="N",
        help="cells side by side (default: one a core, or one on a GPU)",
    )  # fmt: skip
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="run the cells on a Dask cluster, as tcp://HOST:8786"
    )
    parser.add_argument(
        "--explain", nargs=2, metavar=("ROW", "COLUMN"),
        help="where one cell of Table I comes from: '10 sdf' living_room",
    )  # fmt: skip
    parser.add_argument(
        "--measure-again", action="store_true", help="measure Table II although it is cached"
    )
    parser.add_argument("--out", type=a_path, help="folder (default: paper_tables/PRESET)")
    add_device(parser, "of each cell (default: the cores divided by the workers)")
    add_preset(parser)
    parser.set_defaults(command=_tables)


def _tables(options: argparse.Namespace) -> None:
    from nbtrack.experiments.commands_tables import beyond_command, explain_command, tables_command
    from nbtrack.experiments.parallel import Execution

    if options.scenes:
        options.settings.append(f"scenes.names={words_of(options.scenes)}")
    preset, trackers = preset_of(options), tuple(words_of(options.trackers))
    if options.beyond and (trackers or options.measure_again):
        raise ConfigError("--beyond has rows of its own: leave --trackers and --measure-again out")
    if options.explain:
        explain_command(
            preset, options.budget, options.seeds, trackers, *options.explain, options.beyond
        )
        return
    if options.workers is not None and options.workers < 1:
        raise ConfigError(f"--workers {options.workers}: it must be 1 or more, or left out")
    execution = Execution(options.workers, options.threads, options.dask, keep_going=True)
    if options.beyond:
        beyond_command(preset, options.budget, options.seeds, execution, options.out)
        return
    tables_command(
        preset, options.budget, options.seeds, trackers, execution, options.measure_again,
        options.out,
    )  # fmt: skip


def _add_notebooks(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("notebooks", help="run all notebooks headless, with HTML copies")
    parser.add_argument(
        "--in-place", action="store_true", help="store the outputs in the committed notebooks too"
    )
    add_preset(parser)
    parser.set_defaults(command=_notebooks)


def _notebooks(options: argparse.Namespace) -> None:
    from nbtrack.experiments.notebooks import run_notebooks

    preset = preset_of(options)  # refuse a wrong setting before the first kernel starts
    run_notebooks(preset.name, options.config, tuple(options.settings), options.in_place)


def _add_bench(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "bench", help="Table II, step times and mapping speed on this machine, full-size networks"
    )
    parser.add_argument("--out", type=a_path, help="folder of CSV files (default: in the cache)")
    add_device(parser)
    add_preset(parser)
    parser.set_defaults(command=_bench)


def _bench(options: argparse.Namespace) -> None:
    from nbtrack.experiments.commands_bench import bench_command

    # The paper's sizes unless something else is asked for: small networks measure bookkeeping.
    if "NBTRACK_PRESET" not in os.environ:
        options.preset = options.preset or "synthetic"
    bench_command(preset_of(options), options.out)
