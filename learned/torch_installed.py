"""What every module of learned gains needs, imported before them: an extra, as it is larger than all the rest."""

from coopoc.errors import MissingLibraryError

try:
    import torch as torch
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    raise MissingLibraryError("torch", "a learned gain", "'coopoc[learned]'") from None
