"""Run every test with array shapes and types checked at each call of the package."""

import importlib

from jaxtyping import install_import_hook

# What modules of the package import, the hook seeks under another name among the compiled modules,
# does not find and compiles anew, in every process. So libraries come before it.
for library in ("beartype", "cv2", "distributed", "numba", "pandas", "scipy.stats", "trimesh"):
    importlib.import_module(library)

install_import_hook("nbtrack", "beartype.beartype")
