"""Methods: each turns a Recording into a Track."""
