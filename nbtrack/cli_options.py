"""Options that several commands share, and how their mistakes are told."""

import argparse
import os
from pathlib import Path
from typing import NoReturn

from nbtrack.core.config import PRESETS, Preset
from nbtrack.core.errors import ConfigError
from nbtrack.core.settings import resolve_preset


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, as every other user error does."""

    def error(self, message: str) -> NoReturn:
        """Raise a mistake in place of leaving the program."""
        raise ConfigError(f"{message}; see {self.prog} --help")


def a_path(text: str) -> Path:
    """A path; an empty one would be the working folder by accident."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the path is empty")
    return Path(text)


def a_seed(text: str) -> int:
    """A seed: what every generator in use takes."""
    if not (text.isdecimal() and int(text) < 2**63):
        raise argparse.ArgumentTypeError(f"{text!r} is no seed: give a whole number from 0 on")
    return int(text)


def add_preset(parser: argparse.ArgumentParser) -> None:
    """`--preset`, `--config` and `--set`."""
    parser.add_argument("--preset", help=f"{', '.join(PRESETS)} (default: smoke)")
    parser.add_argument("--config", type=a_path, help="TOML file of settings")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="one setting, for example mapping.neus.iterations=500; may be repeated",
    )  # fmt: skip


def add_device(parser: argparse.ArgumentParser, of_what: str = "(default: all cores)") -> None:
    """`--device` and `--threads`."""
    parser.add_argument("--device", help="cuda, cuda:1, mps or cpu (default: the first there is)")
    parser.add_argument("--threads", type=int, metavar="N", help=f"CPU threads {of_what}")


def set_device(options: argparse.Namespace) -> None:
    """Where and with how many threads this process and its workers compute."""
    if getattr(options, "device", None):
        from nbtrack.core.device import named_device

        named_device(options.device)
        os.environ["NBTRACK_DEVICE"] = options.device
    threads = getattr(options, "threads", None)
    if threads is not None:
        import torch

        if threads < 1:
            raise ConfigError(f"--threads {threads}: it must be 1 or more; leave it out for all")
        torch.set_num_threads(threads)


def preset_of(options: argparse.Namespace) -> Preset:
    """The preset with all that changes it."""
    return resolve_preset(options.preset, options.config, tuple(options.settings))


def add_field(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """`--field` and `--supervision`."""
    parser.add_argument("--field", required=required, help="imap, neus or another")
    parser.add_argument(
        "--supervision",
        help="rendering, as in the paper (default); rendering+sdf teaches NeuS the distances too",
    )  # fmt: skip


def field_of(options: argparse.Namespace) -> str:
    """The name of the field with the supervision that is asked for."""
    from nbtrack.fields import supervised_field

    return supervised_field(options.field, options.supervision or "rendering")


def words_of(text: str) -> list[str]:
    """The parts of a list with commas."""
    return [word.strip() for word in text.split(",") if word.strip()]
