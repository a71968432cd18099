"""The command line: options for the functions that the notebooks call."""

import argparse
import importlib
import os
import re
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from nbtrack import __version__
from nbtrack.core.errors import ConfigError, NbtrackError, nearest_name


def a_path(text: str) -> Path:
    """A path; an empty one would be the working folder by accident."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the path is empty")
    return Path(text)


def a_count(text: str, minimum: int = 1, maximum: int = 2**63 - 1) -> int:
    """A number of things, of which there is at least one, that every random generator takes."""
    if not (text.lstrip("-").isdecimal() and minimum <= int(text) <= maximum):
        limits = f"from {minimum} to {maximum}" if maximum < 2**31 else f"that is {minimum} or more"
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number {limits}")
    return int(text)


def _option(help: str, type: Any = str, **more: Any) -> dict[str, Any]:
    return {"help": help, "type": type, **more}


_MAX_THREADS = 1024  # OpenMP ends the process where it cannot start them
# By name, and a word for its value where the name says too little.
OPTIONS = {
    "sequence": _option("a folder, or the name of a room or dataset scene"),
    "folder": _option("a recording", a_path),
    "room": _option("its name"),
    "source": _option("folder of a run or a map, or a map file", a_path),
    "out": _option("file or folder to write", a_path),
    "--format NAME": _option("neural_rgbd, tum, replica, 7scenes, scannet, plain (default: found)"),
    "--method NAME": _option("one of `nbtrack methods` (default: corrected); tables take several, "
                             "as vr,sdf"),
    "--field": _option("in place of a method: imap, neus, neus_plus or another field"),
    "--tracker": _option("in place of a method: vr, sdf, lm or another tracker"),
    "--rate HZ": _option("frames a second, by the clock", float),
    "--steps N": _option("steps a frame (default: until converged; vr, sdf: the paper's at 2 Hz)",
                         float),
    "--pixels N": _option("pixels a step", int),
    "--frames": _option("Python slice of frames, A:B:S", default=":"),
    "--map-frames": _option("Python slice of frames to map (default: all)"),
    "--map-from MAP": _option("track in this map of the room: its folder or file", a_path),
    "--start": _option("given: the first frame's own pose (default where it has one), or unknown",
                       choices=("given", "unknown"), default="given"),
    "--to FORMAT": _option("tum, kitti: trajectory; gif, mp4: movie of a run; ply, glb: "
                            "coloured mesh; map: one file"),
    "--budget BY": _option("steps, the paper's counts (default), or this machine's clock",
                           choices=("steps", "clock"), default="steps"),
    "--scenes A,B": _option("only these scenes of the preset's kind"),
    "--seeds K": _option("K maps and runs a cell: mean ± std", a_count, default=1),
    "--workers N": _option("jobs side by side (default: one a core, or one on a GPU)", a_count),
    "--dask ADDRESS": _option("run on a Dask cluster, as tcp://HOST:8786"),
    "--beyond": {"help": "Table III instead: the paper's methods and ours, 30 Hz too",
                 "action": "store_true"},
    "--n-frames": _option("how many (default: 300)", int, default=300),
    "--width": _option("pixels; the height is 3/4 of it", int, default=640),
    "--motion": _option("handheld: a glance around (default); tour: around the whole room",
                        choices=("handheld", "tour"), default="handheld"),
    "--depth-folder": _option("default: the format's; filtered before raw depth"),
    "--poses FILE": _option("pose file (default: the format's)"),
    "--seed": _option("of all random numbers (default: 0)", partial(a_count, minimum=0), default=0),
    "--out": _option("where to write (default: in runs/)", a_path),
    "--device": _option("cuda, cuda:1, mps or cpu (default: the first there is)"),
    "--threads N": _option(
        "CPU threads (default: all cores)", partial(a_count, maximum=_MAX_THREADS)
    ),
    "--preset": _option("smoke (default), nine_rooms, synthetic or paper"),
    "--config": _option("TOML file of settings", a_path),
    "--set KEY=VALUE": _option("one setting, as mapping.neus.iterations=500; may be repeated",
                               action="append", default=[], dest="settings"),
}  # fmt: skip
_PRESET = " --preset --config --set"
_RUN = " --device --threads" + _PRESET
_MADE = "--frames --seed --out" + _RUN
_PARTS = " --format --depth-folder --poses"
# By name: what it does, and its options; ! marks those that must be. `map` is done by the function
# `map_command`, `data make` by `make_command`.
COMMANDS = {
    "map": ("fit a field to a sequence with known poses",
            "sequence --method --field --format " + _MADE),
    "track": ("track a camera; maps first where no map fits",
              "sequence --method --field --tracker --format --rate --steps --pixels "
              "--map-frames --map-from --start " + _MADE),
    "methods": ("list what --method takes", ""),
    "export": ("a run's trajectory or a map elsewhere", "source out --to!"),
    "tables": ("the paper's tables, and one beyond, CSV and LaTeX",
               "--budget --scenes --method --beyond --seeds --workers --dask --out" + _RUN),
    "notebooks": ("run all notebooks headless, with HTML copies", _PRESET),
    "data make": ("write a synthetic room in the dataset's layout",
                  "room --out! --motion --n-frames --width --seed"),
    "data check": ("what is wrong with a recording", "folder --out" + _PARTS),
    "data convert": ("write a recording in the Neural RGB-D layout",
                     "folder out --frames" + _PARTS),
    "bench": ("Table II on this machine, full-size networks", "--out" + _RUN),
}  # fmt: skip


# Options of earlier versions: what to write now.
_EARLIER = {
    "--supervision": "write --field neus_plus for rendering+sdf",
    "--correct": "write --method corrected, or --set mapping.neus_plus.correct_voxel=METRES",
    "--bake": "lm always works in a grid: write --set tracking.lm.voxel=METRES",
    "--trackers": "write --method A,B",
}


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, with the nearest name, as every other user error does."""

    def error(self, message: str) -> NoReturn:
        """Raise an error that the caller catches; argparse would exit."""
        if wrong := re.search(r"invalid choice: '(.*)' \(choose from (.*)\)", message):
            choices = [choice.strip("' ") for choice in wrong[2].split(",")]
            message = f"unknown {wrong[1]!r}: {nearest_name(wrong[1], choices)}"
        dashed = [word for word in sys.argv[1:] if word.startswith("-") and Path(word).exists()]
        message += "".join(f"; write ./{word} for the file or folder {word}" for word in dashed)
        raise ConfigError(f"{message}; see {self.prog} --help")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status: 0, or 2 after a user's mistake."""
    _open_streams()
    try:
        options = _parsed(arguments)
        _set_device(options)
        module = "bench" if options.command in ("tables", "bench", "notebooks") else "commands"
        commands = importlib.import_module(f"nbtrack.experiments.{module}")
        getattr(commands, f"{options.command}_command")(options)
        return 0
    except NbtrackError as error:
        message, status = " ".join(str(error).split()), 2
    except OSError as error:  # a disk that is full or read-only, a file where a folder should be
        where = error.filename2 or error.filename or "the output"
        message, status = f"{where}: {error.strerror or error}; what was finished is kept: ", 2
        message += "make room or choose another place, and run the same command again"
    except KeyboardInterrupt:
        message, status = "interrupted; run the same command again to go on", 130
    print(f"nbtrack: {message}", file=sys.stderr)
    return status


def _open_streams() -> None:
    """Let nothing that is printed end a command: a daemon's streams are closed, and a terminal's
    encoding may lack letters of a path."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
        if hasattr(stream := getattr(sys, name), "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(prog="nbtrack", description="RGB-D camera tracking in neural scenes.")
    parser.add_argument("--version", action="version", version=f"nbtrack {__version__}")
    groups = {"": parser.add_subparsers(required=True, metavar="COMMAND")}
    known = {name.split()[0]: (name.split(), option) for name, option in OPTIONS.items()}
    for name, (about, options) in COMMANDS.items():
        *group, last = name.split()
        if group and group[0] not in groups:
            part = groups[""].add_parser(group[0], help="make rooms; check or convert a recording")
            groups[group[0]] = part.add_subparsers(required=True, metavar="ACTION")
        command = groups["".join(group)].add_parser(last, help=about, description=about)
        for word in options.split():
            (option, *metavar), keywords = known[word.rstrip("!")]
            keywords = keywords | {"metavar": metavar[0]} if metavar else keywords
            keywords = keywords | {"required": True} if word.endswith("!") else keywords
            command.add_argument(option, **keywords)
        command.set_defaults(command=last, parser=command)
    namespace, unknown = parser.parse_known_args(arguments)
    if unknown:
        known = [option for option in namespace.parser._option_string_actions if option[:2] == "--"]
        name = unknown[0].partition("=")[0]
        advice = _EARLIER.get(name) or nearest_name(name, known)
        namespace.parser.error(f"unknown argument {unknown[0]!r}: {advice}")
    return namespace


def _set_device(options: argparse.Namespace) -> None:
    """Where and with how many threads this process and its workers compute."""
    if getattr(options, "device", None):
        from nbtrack.core.device import named_device

        named_device(options.device)
        os.environ["NBTRACK_DEVICE"] = options.device
    if getattr(options, "threads", None):
        import torch

        torch.set_num_threads(options.threads)
