"""Studies: one short script each, saying what varies, what is held, and which tables and figures answer the question."""
