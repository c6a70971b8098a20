"""Studies: one short script each: what varies, what is held, which tables and figures answer the question."""
