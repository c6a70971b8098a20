"""Federation over Flower: a ClientApp and a ServerApp around the same local training and the same aggregation rules."""

from .client import client_app
from .job import job_of
from .server import rounds, server_app
from .simulation import simulate, train

__all__ = ["client_app", "job_of", "rounds", "server_app", "simulate", "train"]
