"""What a problem is: nodes in a space, measurements between them, losses and constraints."""
