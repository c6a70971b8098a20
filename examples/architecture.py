"""The picture of the net: layers with their sizes and what each takes, drawn from the net itself (section II.B)."""

import sys
from typing import Any

import torch
from torch import fx, nn

from coopoc.learned.nets.gain import Recurrent
from coopoc.learned.recipes import RECIPES
from coopoc.plugins import find
from coopoc.study.plot import canvas

HALF = 0.31
"""Half of the height of a layer's box."""


def layers(net: Recurrent) -> tuple[dict[str, Any], dict[str, list[str]], dict[str, str]]:
    """Layers of a net in the order of a step, what each takes, and the layer that each field of the memory comes from.

    The step is traced, so that the picture shows the net that runs. What a layer takes are names of layers, of fields
    of the memory, and of measurements.

    >>> from coopoc.learned import GainNet
    >>> layers(GainNet())[1]["prior"]
    ['process', 'evolution', 'memory.prior']
    """

    class Step(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = net

        def forward(self, memory: Any, fix: Any, velocity: Any, dt: Any) -> Any:
            return self.net.step(memory, fix, velocity, dt)

    memory = net.start(torch.zeros(1, 3))
    held = type(memory)(*[fx.PH] * len(memory))
    graph = fx.Tracer().trace(Step(), concrete_args={"memory": held})
    fields = iter(f"memory.{field}" for field in memory._fields)
    names = {node: next(fields, node.name) for node in graph.nodes if node.op == "placeholder"}
    names |= {node: str(node.target).removeprefix("net.") for node in graph.nodes if node.op == "call_module"}

    def sources(node: fx.Node) -> list[str]:
        found = ([names[one]] if one in names else sources(one) for one in node.all_input_nodes)
        return list(dict.fromkeys(name for each in found for name in each))

    made = {name: net.get_submodule(name) for node, name in names.items() if node.op == "call_module"}
    (end,) = (node for node in graph.nodes if node.op == "output")
    after = zip(memory._fields, end.args[0], strict=False)
    kept = {field: [name for name in sources(node) if name in made][-1:] for field, node in after}
    takes = {name: sources(node) for node, name in names.items() if name in made}
    return made, takes, {field: name[0] for field, name in kept.items() if name and field not in net.positions}


def main(out: str = "net.png") -> None:
    """Write the picture of the net of the recipe `fedkalmannet`.

    Args:
        out: its file.
    """
    recipe = RECIPES["fedkalmannet"]
    net: Any = find("coopoc.nets", recipe.net)(**dict(recipe.options))
    made, takes, kept = layers(net)
    chain = [name for name in made if any(source in made for source in takes[name]) or f"memory.{name}" in takes[name]]
    place = {name: (1.45 * k, 0.0) for k, name in enumerate(chain)}
    for name in made.keys() - place.keys():  # a layer of features stands above the one that it feeds
        place[name] = (place[next(one for one in chain if name in takes[one])][0], 1.3)
    with canvas(width=9.2, height=3.4) as (figure, panel):
        for name, layer in made.items():
            x, y = place[name]
            recurrent = hasattr(layer, "hidden_size")
            size = (layer.input_size, layer.hidden_size) if recurrent else (layer.in_features, layer.out_features)
            shown = f"{name.replace('_', chr(10))}\n{'GRU' if recurrent else 'Linear'} {size[0]} \u2192 {size[1]}"
            box = {
                "boxstyle": "round,pad=0.35",
                "facecolor": "#F2D9E6" if recurrent else "white",
                "edgecolor": "#555555",
            }
            panel.text(x, y, shown, ha="center", va="center", fontsize=7, bbox=box, zorder=3)
            given = [source.removeprefix("memory.") for source in takes[name] if source not in made]
            fed = [field for field in given if kept.get(field)]
            for source in takes[name]:
                if source in made:
                    apart = chain.index(name) - chain.index(source) if source in chain else 1
                    _arrow(panel, place[source], place[name], 0.22 * (apart > 1))
            for field in fed:
                if kept[field] != name:
                    _arrow(panel, place[kept[field]], place[name], -0.3, "next step")
            if plain := [field.replace("_", " ").replace("gnss", "fix") for field in given if field not in fed]:
                panel.annotate(
                    "\n".join(plain),
                    (x, y + HALF),
                    (x, y + 0.75),
                    ha="center",
                    fontsize=7,
                    arrowprops={"arrowstyle": "->"},
                )
        panel.set(xlim=(-0.8, 1.45 * len(chain) - 0.6), ylim=(-1.85, 2.7))
        panel.axis("off")
    figure.savefig(out, dpi=200)


def _arrow(panel: Any, start: tuple[float, float], end: tuple[float, float], bend: float, words: str = "") -> None:
    """An arrow between two boxes, bent below or above others, dashed if it has words."""
    style = {"arrowstyle": "->", "color": "#0072B2" if words else "#555555", "linestyle": "--" if words else "-"}
    gaps = {"shrinkA": 16, "shrinkB": 16} if start[0] == end[0] else {"shrinkA": 24, "shrinkB": 26}
    if bend:
        (start, end), gaps = ((x, y - HALF) for x, y in (start, end)), {"shrinkA": 4, "shrinkB": 4}
    panel.annotate("", end, start, arrowprops={**style, **gaps, "connectionstyle": f"arc3,rad={bend}"})


if __name__ == "__main__":
    main(*sys.argv[1:])
