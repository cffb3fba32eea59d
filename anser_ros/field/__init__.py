"""The field model, the dipoles that it consists of, and the measurements that it explains."""
