"""The default recogniser: likelihoods over features of the whole ramp, with `unknown`."""
