"""Neural fields, and the registry of their names."""

import torch

from nbtrack.core.bounds import SceneBounds
from nbtrack.fields.base import Field, LearnedField, MappingSettings
from nbtrack.fields.imap import IMapField
from nbtrack.fields.mlp import NetworkSettings
from nbtrack.fields.neus import NeuSField, NeusMapping
from nbtrack.machinery.device import usual_modes
from nbtrack.machinery.errors import look_up_kind
from nbtrack.machinery.inputs import whole_number
from nbtrack.machinery.registry import Registry

FIELDS: Registry[type[Field]] = Registry({"imap": IMapField, "neus": NeuSField})
"""The classes of fields that can be mapped, by name. `FIELDS["mine"] = MyField` adds your own."""


def field_class(name: str) -> type[Field]:
    """The class of fields with a name. Raises ConfigError, with a similar name, for no class."""
    return look_up_kind("field", name, FIELDS, ("name", "label"))


@usual_modes()
def make_field(name: str, network: NetworkSettings, bounds: SceneBounds, seed: int) -> Field:
    """A new field inside `bounds`, whose random weights `seed` determines.

    Raises ConfigError for an unknown name or a seed below 0.
    """
    generator = torch.Generator().manual_seed(whole_number("seed", seed))
    return field_class(name)(network, bounds, generator)
