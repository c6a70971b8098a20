"""A drawing as part of a page: nothing of a file passes but shapes, so that it can neither run nor load anything."""

from __future__ import annotations

import re
from xml.etree import ElementTree

from markupsafe import Markup

from ..escapes import visible
from .marks import SERIES

SVG = "http://www.w3.org/2000/svg"
LINK = "{http://www.w3.org/1999/xlink}href"
SHAPES = {
    "svg",
    "g",
    "defs",
    "path",
    "use",
    "clipPath",
    "rect",
    "circle",
    "ellipse",
    "line",
    "polyline",
    "polygon",
    "image",
}
PLAIN = {
    "d",
    "x",
    "y",
    "x1",
    "y1",
    "x2",
    "y2",
    "cx",
    "cy",
    "r",
    "rx",
    "ry",
    "width",
    "height",
    "transform",
    "viewBox",
    "points",
}
STYLE = re.compile(r"[\w\s:;.,#%()+-]*")
PICTURE = re.compile(r"data:image/png;base64,[A-Za-z0-9+/=\s]*")


def inline(content: bytes, prefix: str) -> Markup | None:
    """The shapes of an SVG file as HTML, ids made unique by a prefix, groups of a method with `data-series`.

    Elements other than shapes and attributes other than their geometry and colours are left out; None for a file that
    is no SVG.

    Args:
        content: of the file.
        prefix: of ids, unique in the page.

    >>> inline(b'<svg xmlns="http://www.w3.org/2000/svg"><script>x</script><path d="M0 0"/></svg>', "a")
    Markup('<svg xmlns="http://www.w3.org/2000/svg"><path d="M0 0" /></svg>')
    """
    if b"<!ENTITY" in content:  # matplotlib writes none, and one can grow without end
        return None
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError:
        return None
    if root.tag != f"{{{SVG}}}svg":
        return None
    ElementTree.register_namespace("", SVG)
    return Markup(ElementTree.tostring(_kept(root, prefix), encoding="unicode"))


def _kept(element: ElementTree.Element, prefix: str) -> ElementTree.Element:
    kept = ElementTree.Element(element.tag, dict(_attributes(element, prefix)))
    for child in element:
        if isinstance(child.tag, str) and child.tag.removeprefix(f"{{{SVG}}}") in SHAPES:
            kept.append(_kept(child, prefix))
    return kept


def _attributes(element: ElementTree.Element, prefix: str) -> list[tuple[str, str]]:
    found = []
    for name, value in element.attrib.items():
        if name == "id" and value.startswith(SERIES):
            found.append(("data-series", visible(value)))
        elif name == "id":
            found.append(("id", f"{prefix}-{value}"))
        elif name in (LINK, "href") and value.startswith("#"):
            found.append(("href", f"#{prefix}-{value[1:]}"))
        elif name in (LINK, "href") and element.tag == f"{{{SVG}}}image" and PICTURE.fullmatch(value):
            found.append(("href", value))
        elif name == "clip-path" and (inside := re.fullmatch(r"url\(#([\w-]+)\)", value)):
            found.append((name, f"url(#{prefix}-{inside[1]})"))
        elif (name == "style" and STYLE.fullmatch(value) and "url" not in value.lower()) or name in PLAIN:
            found.append((name, value))
    return found
