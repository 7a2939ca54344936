"""Jacobians of an MLP with respect to its parameters and its inputs, for whole batches at once."""

from __future__ import annotations

import torch
from torch import Tensor

from loopwright.pipeline.models.static.mlp import MLP


def scaled_output(net: MLP, x: Tensor) -> Tensor:
    """The output before its scaling, s = (y - y_center - x_residual) / y_scale, shape (N, n_out)."""
    a = (x - net.x_center) / net.x_scale
    for weight, bias in zip(list(net.weights)[:-1], list(net.biases)[:-1], strict=True):
        a = torch.tanh(torch.addmm(bias, a, weight))
    return torch.addmm(net.biases[-1], a, net.weights[-1])


@torch.no_grad()
def parameter_jacobian(net: MLP, x: Tensor) -> tuple[Tensor, Tensor]:
    """Scaled output s (N, n_out) and ds/dtheta (N, n_out, P).

    theta holds the parameters in the order of ``net.parameters()``: all weights, then all biases.
    With delta_l = ds/d(preactivation of layer l), found from the last layer back,

        delta_{L+1} = I,   delta_l = (delta_{l+1} W_{l+1}') (1 - a_l^2),
        ds_o/dW_l[i, j] = a_{l-1, i} delta_l[o, j],   ds_o/db_l[j] = delta_l[o, j].
    """
    weights, biases = list(net.weights), list(net.biases)
    layers = [(x - net.x_center) / net.x_scale]
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        layers.append(torch.tanh(torch.addmm(bias, layers[-1], weight)))
    s = torch.addmm(biases[-1], layers[-1], weights[-1])

    n, n_out = len(x), net.n_out
    sizes = [p.numel() for p in net.parameters()]
    ends = list(torch.tensor(sizes).cumsum(0))
    jac = x.new_empty(n, n_out, sum(sizes))
    delta = torch.eye(n_out, dtype=x.dtype).expand(n, -1, -1)
    for layer in reversed(range(len(weights))):
        n_in, width = weights[layer].shape
        w_end, b_end = int(ends[layer]), int(ends[len(weights) + layer])
        jac[:, :, b_end - width : b_end] = delta
        block = jac[:, :, w_end - n_in * width : w_end].view(n, n_out, n_in, width)
        # Written in place: the Jacobian of a chunk is the largest array of the fit.
        torch.mul(layers[layer][:, None, :, None], delta[:, :, None, :], out=block)
        if layer:
            delta = (delta @ weights[layer].T) * (1 - layers[layer] ** 2)[:, None, :]
    return s, jac


@torch.no_grad()
def input_jacobian(net: MLP, x: Tensor) -> Tensor:
    """dy/dx of the prediction, shape (N, n_out, n_in), in engineering units."""
    a = (x - net.x_center) / net.x_scale
    chain = torch.diag(1 / net.x_scale).expand(len(x), -1, -1)  # da_l/dx, (N, n_in, width)
    for weight, bias in zip(list(net.weights)[:-1], list(net.biases)[:-1], strict=True):
        a = torch.tanh(torch.addmm(bias, a, weight))
        chain = (chain @ weight) * (1 - a * a)[:, None, :]
    jac = ((chain @ net.weights[-1]) * net.y_scale).transpose(1, 2).contiguous()
    for o, column in enumerate(net.residual):
        jac[:, o, column] += 1.0
    return jac
