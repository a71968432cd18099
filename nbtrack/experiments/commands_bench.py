"""The `bench` command: Table II, and how far from the arithmetic's floor, on this machine."""

from dataclasses import replace
from pathlib import Path

import pandas as pd
import torch
from tqdm import tqdm

from nbtrack.core.config import Preset
from nbtrack.core.device import choose_device, device_name, suitable_threads
from nbtrack.core.files import write_text_atomic
from nbtrack.core.paths import runs_folder
from nbtrack.core.settings import resolve_preset
from nbtrack.experiments.bench import measure_steps
from nbtrack.experiments.scenes import find_scene
from nbtrack.experiments.speed import (
    measure_mapping,
    measure_step_times,
    peak_memory_gb,
    time_to_distance,
)
from nbtrack.tables.layout import deviations_2, step_texts, table_2


def bench_command(preset: Preset, out: Path | None = None) -> None:
    """Measure and print Table II of both engines, step times, and mapping; write them as CSV."""
    device = choose_device()
    out = out or runs_folder() / "bench" / preset.name
    # One image is enough: a room is made of no more frames than it takes.
    one_image = replace(preset, scenes=replace(preset.scenes, n_frames=2))
    scene = find_scene(preset.scenes.names[0], one_image.scenes)
    sequence = scene.read(slice(0, 1))
    threads = torch.get_num_threads()
    print(f"{preset.name} networks, on {device_name(device)}, {threads} threads")
    times = measure_step_times(preset, sequence, device)
    _show("Time of a step, and how often it holds its arithmetic", times, "step_times", out)
    steps = measure_steps(preset, sequence, device)
    print("Table II: steps within a budget")
    print(step_texts(table_2(steps), deviations_2(steps)).to_string())
    _write(steps, "table_2", out)
    mapping = measure_mapping(preset, scene.read(), device)
    _show("Mapping, per iteration", mapping, "mapping", out)
    ratio = mapping["us_per_sample"].iloc[1] / mapping["us_per_sample"].iloc[0]
    print(f"NeuS over iMAP for equally many samples: {ratio:.2f}")
    smoke = resolve_preset("smoke")
    room = find_scene(smoke.scenes.names[0], smoke.scenes)
    with suitable_threads(1):
        curves = time_to_distance(smoke, room, device)
    _show("A room of the smoke preset to 2 cm near surfaces, one core", curves, "time_to_2cm", out)
    print(f"peak memory: {peak_memory_gb(device):.2f} GB")
    tqdm.write(f"written to {out}")


def _show(title: str, table: pd.DataFrame, name: str, out: Path) -> None:
    print(title)
    print(table.to_string(index=False, float_format="%.4g"))
    _write(table, name, out)


def _write(table: pd.DataFrame, name: str, out: Path) -> None:
    text = table.to_csv(index=False, float_format="%.6g", lineterminator="\n")
    write_text_atomic(out / f"{name}.csv", text)
