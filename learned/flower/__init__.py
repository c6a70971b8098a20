"""Federation over Flower: a ClientApp around the local training of `federate`, asked by Flower's own strategies."""

from .client import client_app, job_of
from .server import rounds, server_app

__all__ = ["client_app", "job_of", "rounds", "server_app"]
