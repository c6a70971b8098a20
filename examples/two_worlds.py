"""Recipes in the world that the shipped weights were not trained in, docs/learned.md: the paper's on real roads
(coopoc.learned.roads), and those of roads in the paper's white noise.

coopoc train examples/two_worlds.py:okf --worse --out runs/two_worlds
coopoc benchmark runs/two_worlds/two_worlds.okf-gnss-axis-0.safetensors --tasks paper --data ~/measured
"""

from dataclasses import replace

from coopoc.learned.recipes import RECIPES, ROADS

fedkalmannet, centralised, okf, fedokf = (
    replace(RECIPES[name], noise=ROADS) for name in ("fedkalmannet", "centralised", "okf", "fedokf")
)
road, fedroad = (replace(RECIPES[name], noise="static") for name in ("road", "fedroad"))
