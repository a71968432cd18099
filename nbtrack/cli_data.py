"""The command line's part on data: making, checking and converting recordings."""

import argparse

from nbtrack.cli_options import a_path, a_seed


def add_data(
    commands: argparse._SubParsersAction, parser_class: type[argparse.ArgumentParser]
) -> None:
    """The command `data` with its actions."""
    parser = commands.add_parser("data", help="make rooms; check or convert a recording")
    actions = parser.add_subparsers(required=True, metavar="ACTION", parser_class=parser_class)
    make = actions.add_parser("make", help="write a synthetic room in the dataset's layout")
    make.add_argument("room", help="its name")
    make.add_argument("--out", type=a_path, required=True, help="folder to write, new")
    make.add_argument("--n-frames", type=int, default=300)
    make.add_argument("--width", type=int, default=640, help="pixels; the height is 3/4 of it")
    make.add_argument("--seed", type=a_seed, default=0)
    make.set_defaults(command=_make)
    check = actions.add_parser("check", help="validate a recording, and say what is wrong with it")
    check.add_argument("folder", type=a_path)
    _add_parts(check)
    check.add_argument(
        "--out", type=a_path, metavar="PATH",
        help="draw the cloud of all frames there: a .png file, or a folder for check.png",
    )  # fmt: skip
    check.set_defaults(command=_check)
    convert = actions.add_parser("convert", help="write a recording in the Neural RGB-D layout")
    convert.add_argument("folder", type=a_path)
    convert.add_argument("out", type=a_path, help="folder to write, new")
    convert.add_argument("--frames", default=":", help="Python slice of frames, A:B:S")
    _add_parts(convert)
    convert.set_defaults(command=_convert)


def add_format(parser: argparse.ArgumentParser) -> None:
    """The option that names a recording's format."""
    parser.add_argument(
        "--format", metavar="NAME",
        help="how the folder is laid out, as neural_rgbd, tum, replica, 7scenes, scannet or plain "
        "(default: told by its files)",
    )  # fmt: skip


def _add_parts(parser: argparse.ArgumentParser) -> None:
    add_format(parser)
    parser.add_argument("--depth-folder", help="default: the format's; filtered before raw depth")
    parser.add_argument("--poses", metavar="FILE", help="pose file (default: the format's)")


def _make(options: argparse.Namespace) -> None:
    from nbtrack.experiments.commands_data import make_command

    make_command(options.room, options.out, options.n_frames, options.width, options.seed)


def _check(options: argparse.Namespace) -> None:
    from nbtrack.experiments.commands_data import check_command

    check_command(options.folder, options.depth_folder, options.poses, options.format, options.out)


def _convert(options: argparse.Namespace) -> None:
    from nbtrack.experiments.commands_data import convert_command

    convert_command(
        options.folder, options.out, options.format, options.frames, options.depth_folder,
        options.poses,
    )  # fmt: skip
