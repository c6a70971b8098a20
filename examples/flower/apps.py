"""The two apps that Flower loads on the server and on every vehicle."""

from coopoc.learned.flower import client_app, server_app

client = client_app()
server = server_app()
