"""Windows of a star's last steps, solved anew at every step."""
