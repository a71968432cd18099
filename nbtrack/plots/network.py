"""A diagram of the network that all fields share."""

from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure

from nbtrack.fields.mlp import FourierMlp
from nbtrack.plots.style import PALETTE, new_axes, styled

_GAP = 6  # letters between the texts of two boxes; lengths in the diagram are in letters
_CENTRED = {"ha": "center", "va": "center", "fontsize": "small"}
_ARROW = {"arrowstyle": "-|>", "color": "0.3", "shrinkA": 0, "shrinkB": 0}


@styled
def plot_network(network: FourierMlp, value: str, title: str = "") -> Figure:
    """A network from a point to a colour and a value: each layer is a box with formula and shape.

    `value` names the fourth output and its unit, such as "density (1/m)".
    """
    hidden = f"{network.activation.__name__}(h W + b)"
    layers = [("sin(x B)", network.frequencies)]
    for layer in (network.layer_1, network.layer_2, network.layer_3, network.layer_4):
        layers.append((hidden, layer.weight.T))
    layers.append(("h W + b", network.head.weight.T))
    texts = [f"{name}\n{matrix.shape[0]} × {matrix.shape[1]}" for name, matrix in layers]
    texts = ["point\n3 (m, world)", *texts, f"sigmoid: colour (3)\n{value}"]
    widths = np.array([max(map(len, text.split("\n"))) for text in texts])
    places = np.cumsum(widths + _GAP) - widths / 2  # the middles of the boxes
    axes = new_axes(title, 1.5)[0, 0]
    boxes = []
    for place, text in zip(places, texts, strict=True):
        edge = "none" if text in (texts[0], texts[-1]) else PALETTE[0]  # layers have an outline
        box = {"boxstyle": "square,pad=0.6", "facecolor": "white", "edgecolor": edge}
        boxes.append(axes.text(place, 0, text, bbox=box, **_CENTRED).get_bbox_patch())
    for (start, end), (here, there) in zip(pairwise(boxes), pairwise(places), strict=True):
        arrow = _ARROW | {"patchA": start, "patchB": end}
        axes.annotate("", (there, 0), (here, 0), arrowprops=arrow)
    # The skip connection, from the sines (box 1; box 0 is the point) to the third layer (box 4).
    skip = {"connectionstyle": "bar,fraction=-0.12", "patchA": boxes[1], "patchB": boxes[4]}
    axes.annotate("", (places[4], 0), (places[1], 0), arrowprops=_ARROW | skip)
    again = "sin(x B) once more, beside the output of the second layer"
    axes.text(places[[1, 4]].mean(), 0.5, again, **_CENTRED)
    axes.set(xlim=(0, places[-1] + widths[-1] / 2 + _GAP), ylim=(-0.4, 0.6))
    axes.set_axis_off()
    return axes.figure
