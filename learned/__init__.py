"""Learned gains: nets that filter, their federated, centralised and individual training, and their shipped weights."""

from .checkpoint import Checkpoint, load, save
from .clients import Client, Pieces, clients
from .federated import Federation, federate
from .gain import Gain
from .method import Diagnostics, LearnedGain
from .net import GainNet
from .okf import NoiseNumbers, OptimisedKF
from .okf_fit import fit_okf
from .recipes import RECIPES, Recipe, Setting, load_method, train_all
from .recursive import RecursiveGain
from .recursive_filter import RecursiveFilter
from .schedule import Schedule
from .split import SplitGain
from .train import Fit, fit

__all__ = [
    "RECIPES", "Checkpoint", "Client", "Diagnostics", "Federation", "Fit", "Gain", "GainNet", "LearnedGain",
    "NoiseNumbers", "OptimisedKF", "Pieces", "Recipe", "RecursiveFilter", "RecursiveGain", "Schedule", "Setting",
    "SplitGain", "clients", "federate", "fit", "fit_okf", "load", "load_method", "save", "train_all",
]  # fmt: skip
