"""The default recognizer: likelihoods over features of the whole ramp, with `unknown`."""
