"""The Neural RGB-D dataset of the paper's experiments (Azinović et al. 2022)."""

DATASET_ZIP = "https://kaldir.vc.in.tum.de/neural_rgbd/neural_rgbd_data.zip"
"""The dataset's only file, 7.25 GB."""
DATASET_SCENES = {
    "breakfast_room": "Breakfast", "complete_kitchen": "Compl. Kitchen",
    "green_room": "Green Room", "grey_white_room": "Grey-white", "kitchen": "Kitchen",
    "morning_apartment": "Morning Apart.", "staircase": "Staircase", "thin_geometry": "Thin Geo.",
    "whiteroom": "Whiteroom",
}  # fmt: skip
"""Folders of the Neural RGB-D dataset, and the names that the paper's Table I gives them."""
DATASET_UNITS = {
    "breakfast_room": 2.5, "complete_kitchen": 5.0, "green_room": 4.0, "grey_white_room": 4.0,
    "kitchen": 4.0, "morning_apartment": 2.0, "staircase": 4.0, "whiteroom": 4.0,
}  # fmt: skip
"""Metres in a unit of each scene. The dataset's own code scales scenes to about [-1, 1]^3; this is
1 / `sc_factor` of its `configs/` (Azinović et al. 2022), which lack `thin_geometry`."""
