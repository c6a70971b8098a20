"""Learned gains: nets that filter, their federated, centralised and individual training, and their shipped weights."""

from . import torch_installed as torch_installed
from .checkpoint import Checkpoint, load, save
from .federation.federate import Participation, federate
from .federation.history import Federation, ledger
from .method import LearnedGain
from .nets.gain import Gain, Recurrent
from .nets.gain_net import GainNet
from .nets.okf import NoiseParameters, OptimisedKF
from .recipes import Recipe, Setting, load_method
from .train import train_all
from .training.clients import Segments, clients
from .training.drives import MeasuredDrives
from .training.fit import fit
from .training.schedule import Schedule

__all__ = [
    "Checkpoint",
    "Federation",
    "Gain",
    "GainNet",
    "LearnedGain",
    "MeasuredDrives",
    "NoiseParameters",
    "OptimisedKF",
    "Participation",
    "Recipe",
    "Recurrent",
    "Schedule",
    "Segments",
    "Setting",
    "clients",
    "federate",
    "fit",
    "ledger",
    "load",
    "load_method",
    "save",
    "train_all",
]
