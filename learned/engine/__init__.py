"""GainNet compiled: rollout, backpropagation through time and optimiser step without Python in the time loop."""
