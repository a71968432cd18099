"""Run every test with array shapes and types checked at each call of the package."""

from jaxtyping import install_import_hook

install_import_hook("nbtrack", "beartype.beartype")
