"""The first block's compiled maximum against the plain one: same numbers, same gradients."""

import pytest
import torch

from sl3d_slam.lines.network.edge_max import edge_max
from sl3d_slam.lines.network.edgeconv import OffsetConv


@pytest.mark.parametrize("count", [1, 5, 700])
def test_numbers_and_gradients_are_those_of_the_plain_form(count):
    torch.manual_seed(count)
    pre = torch.randn(count * 6, 8, requires_grad=True)
    weight = torch.randn(10, 8, requires_grad=True)
    wanted = torch.randn(count, 10)
    plain = (torch.relu(pre) @ weight.T).view(count, 6, 10).amax(dim=1)
    expected = torch.autograd.grad((plain * wanted).sum(), (pre, weight))
    found = edge_max(pre, weight, 6)
    torch.testing.assert_close(found, plain)
    gradients = torch.autograd.grad((found * wanted).sum(), (pre, weight))
    torch.testing.assert_close(gradients[0], expected[0])
    torch.testing.assert_close(gradients[1], expected[1], rtol=1e-4, atol=1e-4)


def test_training_and_inference_give_the_same_features():
    torch.manual_seed(0)
    block, offsets = OffsetConv(4, 16), torch.randn(1100, 20, 4)
    training = block(offsets).detach()
    with torch.no_grad():
        torch.testing.assert_close(block(offsets), training)
