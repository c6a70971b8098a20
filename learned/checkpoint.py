"""Checkpoints: weights in safetensors with a card and a checksum, written atomically, refused if they do not fit."""

import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import safetensors
from safetensors.torch import save as to_bytes
from torch import Tensor

from coopoc import paths
from coopoc.arrays import check_fields, instance, named, whole
from coopoc.errors import InputError, shown
from coopoc.formats.seals import UNSEALED, holds, sealed
from coopoc.paths import given_path
from coopoc.plugins import find, in_file, path_of, points
from coopoc.text import short_repr

from .federation.history import selected
from .nets.gain import Gain, unflatten

_HISTORY, CHECKSUM = "history", "checksum"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained model, its card (recipe, seed, data, noise, metrics, versions), and its weights along the way.

    `history` is (k, P), the weights at the k rows of `card["history"]`, or None.
    """

    model: Gain
    card: Mapping[str, Any]
    history: Tensor | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_fields(self)
        named("card", self.card, "Give name -> value.")

    def after(self, row: int) -> Gain:
        """The net at row `row` of the history: the round of a federation, the check of a fit; 0 is the start. It is not
        calibrated."""
        rows = () if self.history is None else self.history
        kept = whole("row", row, 0, len(rows) - 1, "This checkpoint holds no more weights.")
        return unflatten(rows[kept], self.model)

    def kept(self, row: int) -> int:
        """Row up to `row` whose weights are kept by a training that ended there (`federation.history.selected`)."""
        return selected(self.card["history"][: row + 1], self.card["training_pieces"], self.card["clients"])


def save(path: Path | str, checkpoint: Checkpoint) -> Path:
    """Write weights, history and card to one safetensors file; a reader sees the old file or the new one whole.

    The card's "checksum" is the SHA-256 of the whole file (`coopoc.formats.seals`).

    Raises:
        InputError: a net of a class that is no entry point in `coopoc.nets`: the file could not be read again; a card
            that holds what JSON cannot.
    """
    path, model = given_path(path), instance("checkpoint", checkpoint, Checkpoint).model
    card = dict(checkpoint.card) | {
        "environment": {"python": platform.python_version()} | {n: version(n) for n in ("coopoc", "torch", "numpy")},
        "kind": kind(model),
        "net": dict(model.settings),
        "parameters": sum(p.numel() for p in model.parameters()),
    }
    tensors = {name: tensor.contiguous() for name, tensor in model.state_dict().items()}
    if checkpoint.history is not None:
        tensors[_HISTORY] = checkpoint.history
    write(path, tensors, card)
    return path


def write(path: Path, tensors: Mapping[str, Tensor], card: Mapping[str, Any]) -> None:
    """Write tensors and a card with the checksum of both; `read` checks it."""
    last = {name: card[name] for name in sorted(card) if name != CHECKSUM} | {CHECKSUM: UNSEALED}
    try:
        text = json.dumps(last)
    except (TypeError, ValueError, RecursionError) as error:
        allowed = f"must hold what JSON can ({error})"
        raise InputError("card", shown(card), allowed, "Convert its values to numbers, texts and lists.") from None
    paths.write(path, sealed(to_bytes(dict(tensors), metadata={"card": text})))


def kind(model: Gain) -> str:
    """Name of a net's class among the entry points `coopoc.nets`, or "mine.py:Net" for one of a file.

    Raises:
        InputError: a class that is neither an entry point nor loaded from a file by its path.
    """
    made = type(model)
    value = f"{made.__module__}:{made.__qualname__}"
    for name, point in points("coopoc.nets").items():
        if point.value == value:
            return name
    if path := path_of(made):
        return f"{path.name}:{made.__qualname__}"
    hint = 'Name it by its file, "mine.py:Net", or in [project.entry-points."coopoc.nets"] of your package.'
    raise InputError("net", value, "must be an entry point in coopoc.nets or come from a file", hint)


def load(path: Path | str, net: str = "") -> Checkpoint:
    """Read a checkpoint and check every tensor's shape against its card. No code named by the file alone is run.

    Args:
        path: of the safetensors file.
        net: the net, "folder/mine.py:Net", if it is one of your own files; a card cannot name such a file.

    Raises:
        InputError: no such file, a wrong checksum or none, no card, a kind of net that is not installed, a file that
            `net` does not name, or tensors of another shape than its net has.
    """
    path, net = given_path(path), instance("net", net, str, 'Give "mine.py:Net".')
    tensors, card = read(path)
    if not isinstance(card.get("kind"), str) or not isinstance(card.get("net"), dict):
        kind_and_net = {name: card.get(name) for name in ("kind", "net")}
        allowed = "must name a kind of net and its settings"
        raise InputError(f"checkpoint {path}: card", kind_and_net, allowed, "Write it with save.")
    if in_file(card["kind"]) and not net:
        allowed = "names a file, whose code does not run unless you name it, too"
        hint = f"If you trust that file: load({str(path)!r}, net={card['kind']!r})."
        raise InputError(f"checkpoint {path}: kind", repr(card["kind"]), allowed, hint)
    made = find("coopoc.nets", net or card["kind"])
    history = tensors.pop(_HISTORY, None)
    try:
        model = made(**card["net"])
        model.load_state_dict(tensors)
    except (TypeError, RuntimeError) as error:
        allowed = f"does not fit ({' '.join(str(error).split())})"
        raise InputError(f"checkpoint {path}: net", card["net"], allowed, "Train it again.") from None
    size = sum(p.numel() for p in model.parameters())
    if history is not None and history.shape[1:] != (size,):
        raise InputError(f"checkpoint {path}: history", history.shape, f"must be (rows, {size})", "Train it again.")
    return Checkpoint(model.eval(), card, history)


def read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and card of a file, its checksum checked.

    Raises:
        InputError: no such file, another format, a wrong checksum or none.
    """
    if not path.is_file():
        raise InputError("checkpoint", path, "must be an existing file", "Train it with train_all or coopoc train.")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            card = json.loads((file.metadata() or {}).get("card", "null"))
    except safetensors.SafetensorError as error:
        raise InputError("checkpoint", path, f"is no safetensors file ({error})", "Train it again.") from error
    except (ValueError, RecursionError) as error:
        raise InputError("checkpoint", path, f"has a damaged card ({error})", "Train it again.") from None
    if not isinstance(card, dict):
        raise InputError(
            "checkpoint", path, "must carry a card of named fields in its metadata", "Write it with checkpoint.save."
        )
    if not holds(path.read_bytes()):
        hint = "Copy it again from where it came from, or write it with coopoc.learned.save."
        raise InputError("checkpoint", path, "has no checksum, or another content than it says: it is damaged", hint)
    return tensors, card
