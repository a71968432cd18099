"""The command line: its commands, their options, and how errors are told."""

import argparse
import importlib
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TextIO

from nbtrack import __version__
from nbtrack.data.dataset import DATASET_ZIP
from nbtrack.machinery.errors import ConfigError, NbtrackError, nearest_name


def a_path(text: str) -> Path:
    """Parse a path, and expand `~`. An empty text, which would mean the working folder, is refused.

    Raises what argparse reports as a user's error, as the other functions that parse an option.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError("the path is empty")
    # The `~` of an unknown user stays, and is refused where the path is used.
    return Path(os.path.expanduser(text))


def a_count(text: str, minimum: int = 1, maximum: int = 2**31 - 1) -> int:
    """Parse a whole number from `minimum` to `maximum`, by default the largest seed of a room.

    Another text raises what argparse reports as a user's error.
    """
    if not (re.fullmatch(r"-?\d{1,18}", text) and minimum <= int(text) <= maximum):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from {minimum} to {maximum}")
    return int(text)


def _option(help: str, type: Any = str, **more: Any) -> dict[str, Any]:
    """The keyword arguments of argparse's `add_argument` for an option that takes a value."""
    return {"help": help, "type": type, **more}


some_seeds = partial(a_count, maximum=1000)
_STARTS = {"choices": ("given", "unknown"), "default": "given"}
_BUDGETS = {"choices": ("steps", "clock"), "default": "steps"}
_SETTINGS = {"action": "append", "default": [], "dest": "settings", "metavar": "KEY=VALUE"}
_CAPTION = {"nargs": "?", "const": "", "metavar": "TEXT"}
_FLAG = {"action": "store_true"}
_IMPORTS = {"action": "append", "default": [], "dest": "imports", "metavar": "FILE.py"}
OPTIONS = {
    "sequence": _option("a folder, or the name of a room or dataset scene"),
    "folder": _option("a recording", a_path),
    "room": _option("its name"),
    "scene": _option("its name, as breakfast_room"),
    "source": _option("folder of a run or a map, or a map file", a_path),
    "out": _option("file or folder to write", a_path),
    "--format": _option("a format's name, as in data/README.md (default: told by the files)"),
    "--method": _option("one of `nbtrack methods` (default: corrected)"),
    "--method:tables": _option("some of `nbtrack methods` (default: vr,sdf)", metavar="A,B"),
    "--field": _option("in place of a method: imap, neus, neus_plus or another field"),
    "--tracker": _option("in place of a method: vr, sdf, lm or another tracker"),
    "--rate": _option("frames a second, by the clock", float, metavar="HZ"),
    "--steps": _option("steps a frame (default: to convergence; vr, sdf: as at 2 Hz)", float),
    "--frames": _option("Python slice of frames, A:B:S (default: all)", default=":"),
    "--map-frames": _option("Python slice of frames to map (default: all)"),
    "--map-from": _option("track in this map of the room: its folder or file", a_path),
    "--start": _option("given: its own pose, if any (default); unknown: found first", **_STARTS),
    "--to": _option("kitti: trajectory; gif: movie; rrd: Rerun; ply, glb: mesh", required=True),
    "--budget": _option("steps: the paper's counts (default); clock: this machine's", **_BUDGETS),
    "--scenes": _option("only these scenes (default: the preset's)", metavar="A,B"),
    "--seeds": _option("so many maps and runs a cell (default: 1)", some_seeds, default=1),
    "--workers": _option("jobs side by side (default: one a core, or one on a GPU)", a_count),
    "--dask": _option("run on a Dask cluster, as tcp://HOST:8786", metavar="ADDRESS"),
    "--beyond": {"help": "Table III: our methods too, and 30 Hz", **_FLAG},
    "--caption": _option("of the LaTeX table (default: ours; without a text: short)", **_CAPTION),
    "--label": _option("of the LaTeX table (default: tab:ate-PRESET)"),
    "--no-still": {"help": "without the rows of a camera that stands still", **_FLAG},
    "--n-frames": _option("how many (default: 300)", int, default=300),
    "--width": _option("pixels (default: 640; 160 takes a tenth of the time)", int, default=640),
    "--motion": _option("handheld (default), keyframes: the dataset's, tour", default="handheld"),
    "--depth-folder": _option("default: the format's; filtered before raw depth"),
    "--url": _option("its ZIP file, address or path (default: the authors')", default=DATASET_ZIP),
    "--poses": _option("pose file (default: the format's)", metavar="FILE"),
    "--seed": _option("of all random numbers (default: 0)", partial(a_count, minimum=0), default=0),
    "--out": _option("where to write (default: in runs/)", a_path),
    "--out:make": _option("the folder to write", a_path, required=True),
    "--out:check": _option("folder for a picture, check.png (default: none)", a_path),
    "--device": _option("cuda, cuda:1, mps or cpu (default: the first there is)"),
    "--preset": _option("smoke (default), nine_rooms, synthetic or paper"),
    "--preset:bench": _option("smoke, nine_rooms, synthetic (default) or paper"),
    "--config": _option("TOML file of settings", a_path),
    "--set": _option("one setting, as mapping.neus.iterations=500; may be repeated", **_SETTINGS),
    "--import": _option("your file or module of fields, trackers, methods first", **_IMPORTS),
}
# Options that several commands have, as words for `COMMANDS`.
_RUN = " --out --device --config --set"
_MADE = " --method --field --format --frames --seed --preset" + _RUN
_PARTS = " --format --depth-folder --poses"
_TRACKED = " --tracker --rate --steps --map-frames --map-from --start"
_CELLS = "--budget --scenes --method:tables --beyond --seeds --workers --dask --preset"
_CELLS += " --caption --label --no-still"
_MODULES = {"tables": "bench", "bench": "bench", "export": "exports"}  # the others: "commands"
# Each command's help and the words of its options, which are keys of `OPTIONS`. A colon and a word
# after an option choose one of its meanings. The function of the command `map` is `map_command`,
# that of `data make` is `make_command`.
COMMANDS = {
    "map": ("fit a field to a sequence with known poses", "sequence" + _MADE),
    "track": ("track a camera; maps first where no map fits", "sequence" + _MADE + _TRACKED),
    "methods": ("list what --method takes", ""),
    "export": ("a run's trajectory or a map elsewhere", "source out --to"),
    "tables": ("the paper's tables, and one beyond, CSV and LaTeX", _CELLS + _RUN),
    "data fetch": ("bring a scene of the dataset, not all 7 GB", "scene --url"),
    "data make": ("write a synthetic room", "room --out:make --motion --n-frames --width --seed"),
    "data check": ("what is wrong with a recording", "folder --out:check" + _PARTS),
    "data convert": ("write a recording as the dataset is", "folder out --frames" + _PARTS),
    "bench": ("Table II on this machine, full-size networks", "--preset:bench" + _RUN),
}


class Parser(argparse.ArgumentParser):
    """A parser whose errors are ConfigErrors with one line, as all other errors of a user are."""

    def error(self, message: str) -> NoReturn:
        """Raise ConfigError, where argparse would exit; it suggests the nearest of the choices."""
        if wrong := re.search(r"invalid choice: '(.*)' \(choose from (.*)\)", message):
            choices = [choice.strip("' ") for choice in wrong[2].split(",")]
            message = f"unknown {wrong[1]!r}: {nearest_name(wrong[1], choices)}"
            # The value of an option before the command is taken for the command.
            message += "; options follow the command" if self.prog == "nbtrack" else ""
        raise ConfigError(f"{message}; see {self.prog} --help")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status.

    The status is 0; 2 after a user's mistake; 130 after Ctrl-C; 1 if `data check` finds a recording
    wrong, or if the program that reads the output has closed it. If `NBTRACK_DEBUG` is set, the
    traceback of a mistake or of Ctrl-C is printed, too.
    """
    sys.stdout = _writable(sys.stdout)
    sys.stderr = _writable(sys.stderr)
    try:
        options = _parsed(arguments)
        if options.device:
            os.environ["NBTRACK_DEVICE"] = options.device
        for source in options.imports:
            importlib.import_module("nbtrack.machinery.registry").import_own(source)
        module = _MODULES.get(options.command, "commands")
        status = getattr(_imported(module), f"{options.command}_command")(options)
        print(end="", flush=True)  # raises BrokenPipeError here, and not when Python ends
        return status or 0
    except BrokenPipeError:  # the program that reads the output, such as `head`, has closed it
        for descriptor in (1, 2):  # stdout and stderr: discards what Python flushes when it ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
        return 1
    except (NbtrackError, OSError, MemoryError, KeyboardInterrupt) as error:
        if os.environ.get("NBTRACK_DEBUG"):
            traceback.print_exception(error)
        print(f"nbtrack: {_message_of(error)}", file=sys.stderr)
        return 130 if isinstance(error, KeyboardInterrupt) else 2  # 130 is what shells return


def _imported(module: str) -> Any:
    """A module with commands. While it is imported, Ctrl-C ends the process at once.

    Nothing has begun by then. A library that is interrupted while it is imported may go on, or
    raise another error.
    """
    # Only the main thread may set a handler. None stands for a handler that is not Python's, which
    # could not be restored: it stays.
    is_main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT) if is_main else None
    if before is None:
        return importlib.import_module(f"nbtrack.experiments.{module}")
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        return importlib.import_module(f"nbtrack.experiments.{module}")
    finally:
        signal.signal(signal.SIGINT, before)


def _writable(stream: TextIO | None) -> TextIO:
    """The stream, changed so that every text can be written to it.

    Letters that its encoding lacks, as in a path, are escaped. Python has None for a stream that is
    closed, as a daemon's is; a stream that discards all text then takes its place.
    """
    if stream is None:
        stream = open(os.devnull, "w")  # noqa: SIM115 (it stays open until Python ends)
    if hasattr(stream, "reconfigure"):
        stream.reconfigure(errors="backslashreplace")
    return stream


def _message_of(error: BaseException) -> str:
    """The line that tells a user what ended a command."""
    if isinstance(error, NbtrackError):
        return " ".join(str(error).split())
    if isinstance(error, OSError):  # as of a full disk, or of a file in place of a folder
        # When a file is renamed, the second name is the new one.
        where = error.filename2 or error.filename or "the output"
        return f"{where}: {error.strerror or error}; mend it and run again"
    if isinstance(error, MemoryError):  # outside of jobs, which say what needs the memory
        return "out of memory: take fewer frames, as with --frames ::2"
    return f"interrupted; {str(error) or 'run the same command again to go on'}"


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options of a command line. A wrong line raises ConfigError with the nearest name."""
    parser = Parser(prog="nbtrack", description="RGB-D camera tracking in neural scenes.")
    parser.add_argument("--version", action="version", version=f"nbtrack {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    data = commands.add_parser("data", help="make or fetch recordings, check, convert")
    actions = data.add_subparsers(required=True, metavar="ACTION")
    for name, (about, words) in COMMANDS.items():
        group = actions if name.startswith("data ") else commands
        last = name.split()[-1]
        command = group.add_parser(last, help=about, description=about)
        for word in [*words.split(), "--import"]:
            command.add_argument(word.partition(":")[0], **OPTIONS[word])
        # `main` asks for the device, but not every command has --device.
        command.set_defaults(command=last, parser=command, device=None)
    # `parse_args` would report unknown arguments itself, without the nearest name.
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        given = unknown[0].partition("=")[0]
        known = [name for name in options.parser._option_string_actions if name.startswith("--")]
        takers = [
            name
            for name, (_, words) in COMMANDS.items()
            if given in [word.partition(":")[0] for word in words.split()]
        ]
        hint = f"only for {', '.join(takers)}" if takers else nearest_name(given, known)
        if not given.startswith("-"):
            hint = "give the command no more than it takes"
        options.parser.error(f"unknown argument {unknown[0]!r}: {hint}")
    words = sys.argv[1:] if arguments is None else arguments
    for name in ("--scenes", "--method"):
        if sum(word.partition("=")[0] == name for word in words) > 1:
            options.parser.error(f"{name} is given twice: give it once, as A,B if it is a list")
    for name, value in vars(options).items():
        if value == "" and name != "caption":  # as of a variable that is not set
            options.parser.error(f"{name} is empty: give a value, or leave it out")
    return options
