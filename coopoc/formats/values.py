"""Values in text files: words and finite numbers by line, rotations, and symmetric matrices by their upper triangle."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy import nan
from numpy.linalg import eigh, eigvalsh, inv

from ..arrays import Floats, Ints
from ..errors import InputError

MAX_NUMBER = 1e100
"""Numbers beyond it are none that was measured, and their squares overflow."""
MIN_DIAGONAL = 1e-100
"""Least entry of a diagonal, and one over the largest: products of what is beyond them leave the range of numbers."""
QUATERNION_ROUNDING = 1e-2
"""|norm - 1| of a quaternion that was merely rounded (to three decimals); more is not a rotation."""


def read_words(path: Path) -> Iterator[tuple[int, list[str]]]:
    """(line number, words) of every line that is neither blank nor a comment, which starts with #.

    Raises:
        InputError: no such file, or no text.
    """
    if not path.is_file():
        raise InputError("path", path, "must be a file", "Check the path.")
    try:
        lines = path.read_text("utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise InputError(path.name, error, "must be text in UTF-8", "Save it so, if it is that file.") from None
    for number, line in enumerate(lines, 1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield number, words


def to_numbers(file: str, lines: Sequence[int], words: Sequence[Sequence[str]], form: str, columns: int) -> Floats:
    """(M, columns) finite numbers of M lines.

    Args:
        file: name, for messages.
        lines: (M,) line numbers, for messages.
        words: (M, columns).
        form: of a line, for messages.
        columns: numbers in a line.

    Raises:
        InputError: another number of words, a word that is no number or not a finite one, with its line.

    >>> to_numbers("a.txt", [1], [["0", "1e3"]], "x y", 2)
    array([[   0., 1000.]])
    """
    values = np.empty((len(words), columns))
    for row, line in enumerate(words):
        try:
            values[row] = [_number(word) for word in line] if len(line) == columns else nan
        except ValueError:
            values[row] = nan
    bad = np.flatnonzero(~(abs(values) <= MAX_NUMBER).all(axis=1))
    if len(bad):
        raise malformed(file, lines[bad[0]], words[bad[0]], form)
    return values


def _number(word: str) -> float:
    """A number as C writes it: Python's float takes digits of any script and underscores, too."""
    return float(word) if word.isascii() and "_" not in word else float("nan")


def malformed(file: str, line: int, words: Sequence[str], form: str) -> InputError:
    """The error of a line that does not have its form."""
    shown = " ".join(word if len(word) <= 40 else f"{word[:40]}..." for word in words[:40])
    actual = f"{shown}{' ...' if len(words) > 40 else ''} ({len(words)} words)"
    return InputError(
        f"{file}: line {line}", actual, f"must be {form}, all finite numbers", "Correct or remove the line."
    )


def read_table(path: Path, form: str) -> tuple[Ints, Floats]:
    """(M,) line numbers and (M, columns) numbers of a file whose lines all have the same form, as "t x y z".

    Raises:
        InputError: what `read_words` and `to_numbers` raise, or a file without a line.
    """
    rows = list(read_words(path))
    if not rows:
        raise InputError(path.name, "0 lines", f"must hold lines {form}", "Check that the file is complete.")
    lines = [number for number, _ in rows]
    return np.array(lines), to_numbers(path.name, lines, [words for _, words in rows], form, len(form.split()))


def to_rotation(orientation: Floats) -> Floats:
    """Rotation matrices of angles or quaternions, R(theta) or R(q / |q|).

    Args:
        orientation: (..., 1) angle, rad, or (..., 4) quaternion qx qy qz qw. NaN gives NaN.

    Returns:
        (..., 2, 2) or (..., 3, 3).

    >>> to_rotation(np.array([0.0, 0, 0, 1])).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    if orientation.shape[-1] == 1:
        c, s = np.cos(orientation[..., 0]), np.sin(orientation[..., 0])
        return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    from scipy.spatial.transform import Rotation  # a quarter of a second, which a missing file need not wait for

    quaternions = orientation.reshape(-1, 4)
    matrices, finite = np.full((len(quaternions), 3, 3), nan), np.isfinite(quaternions).all(axis=1)
    matrices[finite] = Rotation.from_quat(quaternions[finite]).as_matrix()
    return matrices.reshape(*orientation.shape[:-1], 3, 3)


def to_orientation(rotation: Floats) -> Floats:
    """The inverse of `to_rotation`: an angle in (-pi, pi], or the unit quaternion with qw >= 0.

    Args:
        rotation: (..., 2, 2) or (..., 3, 3).

    Returns:
        (..., 1) rad or (..., 4) qx qy qz qw.

    >>> to_orientation(np.array([[0.0, -1], [1, 0]])).round(4)
    array([1.5708])
    """
    if rotation.shape[-1] == 2:
        return np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])[..., None]
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(quaternions).reshape(*rotation.shape[:-2], 4)


def symmetric(upper: Floats, size: int) -> Floats:
    """(M, size, size) matrices of (M, size (size + 1) / 2) upper triangles by rows.

    >>> symmetric(np.array([[1.0, 2, 3]]), 2).tolist()
    [[[1.0, 2.0], [2.0, 3.0]]]
    """
    i, j = np.triu_indices(size)
    out = np.empty((len(upper), size, size))
    out[:, i, j] = out[:, j, i] = upper
    return out


REPAIRED = 1e-6
"""Share of the largest eigenvalue, after scaling, that a repaired matrix has at least: none would have no inverse."""


def inverse(matrices: Floats, location: Callable[[int], str], repairs: list[str] | None = None) -> Floats:
    """Inverses of M symmetric positive definite matrices of information.

    Rows and columns are first scaled by powers of two, which is exact, so that metres beside radians cost no digits.

    Args:
        matrices: (M, size, size).
        location: row -> where it stands, for the message.
        repairs: gets a line for each matrix that was not positive definite and whose eigenvalues, scaled to a unit
            diagonal, were raised to REPAIRED of the largest; None: such a matrix is an error.

    Raises:
        InputError: a matrix that is singular or not positive, at its place.

    >>> inverse(np.array([[[4.0, 0], [0, 1e8]]]), "line {}".format).tolist()
    [[[0.25, 0.0], [0.0, 1e-08]]]
    """
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    positive = (diagonal > MIN_DIAGONAL) & (diagonal < 1 / MIN_DIAGONAL)
    scale = np.exp2(np.rint(-0.5 * np.log2(np.where(positive, diagonal, 1))))
    both = scale[:, :, None] * scale[:, None, :]
    scaled = matrices * both
    for row in np.flatnonzero(~positive.all(axis=-1) | (eigvalsh(scaled)[:, :1] < 1e-13).any(axis=-1)).tolist():
        own, axes = eigh(scaled[row])
        if repairs is None or not own[-1] > 0:
            raise InputError(
                location(row),
                f"information {matrices[row][np.triu_indices(len(own))].tolist()}",
                "must be positive definite: a singular one has no inverse",
                "Give every component some information or leave the measurement out."
                + " Or read with repair=True (coopoc solve --repair), which takes the nearest that is."
                * bool(own[-1] > 0),
            )
        scaled[row] = axes * np.maximum(own, REPAIRED * own[-1]) @ axes.T
        repairs.append(
            f"{location(row)}: information was not positive definite and was replaced by the nearest that is"
        )
    inverses = inv(scaled) * both
    return np.asarray(0.5 * (inverses + inverses.mT))
