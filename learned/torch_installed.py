"""What every module of learned gains needs, imported before them: an extra, as it is larger than all the rest."""

from coopoc import MissingLibraryError

try:
    import torch as torch  # the larger one is named first
    import safetensors as safetensors  # isort: skip
except ModuleNotFoundError as error:
    if error.name not in ("safetensors", "torch"):
        raise
    raise MissingLibraryError(error.name, "a learned gain", "'coopoc[learned]'") from None
