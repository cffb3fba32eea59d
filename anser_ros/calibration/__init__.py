"""Calibrates a field model: a scan's fluxes and poses become virtual dipoles with moments.

Everywhere in this package, unless a docstring says otherwise: ``measurements`` are one
`Measurements` per body and session, of F frames, S sensors and K emitters; ``weights`` (F, S) of
readings lie in [0, 1], 0 for unusable ones; a model has N dipoles (``dipoles``, ``sites``) with
complex ``moments`` (N, K), A m^2, which ``damping`` (Tikhonov's parameter as a fraction of the
largest singular value of the scaled matrix) pulls to zero or to a ``prior`` (N, K). Real residuals
(..., 2K) have real and imaginary parts by turns; ``noise_t`` is that of one part, T. Poses are
wrong by shifts (m) and rotation vectors (rad), (F, 6), frame fg, with the inverse variances
``precision`` (6,). ``folds`` are the held-out blocks of space of the frames (F,), ``nominal`` is
the model of the drawing, and ``progress`` is called with the name of a stage and its finished
fraction.
"""
