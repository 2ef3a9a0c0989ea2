"""Stateless operators, each with a plain reference beside its fast kernels.

The modules at this level are the public operators; `reference` defines them in torch or numpy, `cpu` and `gpu` are
fast. Those on tensors are differentiable, in float32, and run on a GPU, too; those on surfaces of revolution, height
fields and level sets are in numpy and float64, without automatic derivatives, on the CPU only. Shapes that do not
fit raise `ValueError`.

This room may import torch, numpy, scipy, numba, triton and its own constants; it imports no other room of the project.
"""
