"""Stateless differentiable operators, each with a plain torch reference beside its fast kernels.

This room may import torch, numpy, numba, triton and its own constants; it imports no other room of the project. Shapes
that do not fit raise `ValueError`. The modules at this level are the public operators; `reference`, `cpu` and `gpu`
implement them.
"""
