"""Learned gains: GainNet, its federated, centralised and individual training, and the optimised Kalman filter."""

from .checkpoint import Checkpoint, load, save
from .clients import Client, Pieces, clients
from .federated import Federation, federate
from .gain import Gain
from .method import Diagnostics, LearnedGain
from .net import GainNet
from .okf import NoiseNumbers, OptimisedKF
from .okf_fit import fit_okf
from .recipes import RECIPES, Recipe, Setting, load_method, train_all
from .schedule import Schedule
from .train import Fit, fit

__all__ = [
    "RECIPES", "Checkpoint", "Client", "Diagnostics", "Federation", "Fit", "Gain", "GainNet", "LearnedGain",
    "NoiseNumbers", "OptimisedKF", "Pieces", "Recipe", "Schedule", "Setting",
    "clients", "federate", "fit", "fit_okf", "load", "load_method", "save",
    "train_all",
]  # fmt: skip
