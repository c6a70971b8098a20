"""Learned gains: nets that filter, their federated, centralised and individual training, and their shipped weights."""

from .checkpoint import Checkpoint, load, save
from .federation.federated import Federation, federate
from .federation.history import ledger
from .federation.participation import Participation
from .method import Diagnostics, LearnedGain
from .nets.cooperative import CooperativeGain
from .nets.gain import Gain
from .nets.gain_net import GainNet
from .nets.noise_net import NoiseNet
from .nets.okf import NoiseNumbers, OptimisedKF
from .nets.recursive import RecursiveGain
from .nets.recursive_filter import RecursiveFilter
from .nets.split import SplitGain
from .privacy.differential import Privacy
from .privacy.secure import SecureMean
from .recipes import RECIPES, Recipe, Setting, load_method, train_all
from .training.clients import Client, Pieces, clients
from .training.fit import Fit, fit
from .training.okf_fit import fit_okf
from .training.schedule import Schedule

__all__ = [
    "RECIPES", "Checkpoint", "Client", "CooperativeGain", "Diagnostics", "Federation", "Fit", "Gain", "GainNet",
    "LearnedGain", "NoiseNet", "NoiseNumbers", "OptimisedKF", "Participation", "Pieces", "Privacy", "Recipe",
    "RecursiveFilter", "RecursiveGain", "Schedule", "SecureMean", "Setting", "SplitGain", "clients", "federate", "fit",
    "fit_okf", "ledger", "load", "load_method", "save", "train_all",
]  # fmt: skip
