"""Where a solve starts, and which of several starts is believed."""
