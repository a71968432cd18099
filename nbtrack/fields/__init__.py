"""Neural fields. A module in this folder that registers a field makes it known everywhere."""

import importlib
import pkgutil

from nbtrack.data.pixels import Rays
from nbtrack.fields.base import (
    FIELDS,
    Field,
    LearnedField,
    Linearization,
    field_class,
    make_field,
    supervised_field,
)

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

__all__ = [
    "FIELDS",
    "Field",
    "LearnedField",
    "Linearization",
    "Rays",
    "field_class",
    "make_field",
    "supervised_field",
]
