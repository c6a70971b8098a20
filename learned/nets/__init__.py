"""What is trained: nets that filter, as functions of flat weights."""
