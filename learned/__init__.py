"""Learned gains: GainNet, its federated, centralised and individual training, and the optimised Kalman filter."""

from .checkpoint import Checkpoint, load, save
from .clients import Client, Pieces, clients
from .federated import Federation, federate
from .method import Diagnostics, LearnedGain
from .net import GainNet
from .okf import OptimisedKF, fit_okf
from .recipes import RECIPES, Recipe, Setting, load_method, train_all
from .schedule import Schedule
from .train import Fit, fit

__all__ = [
    "RECIPES", "Checkpoint", "Client", "Diagnostics", "Federation", "Fit", "GainNet", "LearnedGain", "OptimisedKF",
    "Pieces", "Recipe", "Schedule", "Setting", "clients", "federate", "fit", "fit_okf", "load", "load_method", "save",
    "train_all",
]  # fmt: skip
