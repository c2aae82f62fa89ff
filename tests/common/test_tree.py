"""Tensors in nested dictionaries and tuples."""

from typing import Any, NamedTuple

import pytest
import torch as th

from sb3_policyflow.common.tree import in_chunks, map_tensors, rows, tensors


class Record(NamedTuple):
    latents: th.Tensor
    more: Any = ()


def tree(n: int = 6) -> dict[str, Any]:
    numbers = th.arange(n)
    return {"record": Record(numbers.float(), {"a": numbers}), "pair": (numbers, -numbers)}


def test_types_and_names_are_kept() -> None:
    mapped = map_tensors(lambda values: values + 1, tree())
    assert list(mapped) == ["record", "pair"]
    assert type(mapped["record"]) is Record
    assert type(mapped["pair"]) is tuple
    assert mapped["record"].latents.tolist() == [1, 2, 3, 4, 5, 6]
    assert mapped["record"].more["a"].tolist() == [1, 2, 3, 4, 5, 6]
    assert mapped["pair"][1].tolist() == [1, 0, -1, -2, -3, -4]


@pytest.mark.parametrize(
    "empty", [(), {}, Record((), ())], ids=["tuple", "dictionary", "named tuple"]
)
def test_what_holds_no_tensors_is_left_as_it_is(empty: Any) -> None:
    assert map_tensors(lambda values: values + 1, empty) == empty
    assert list(tensors(empty)) == []


@pytest.mark.parametrize("other", [1.0, "a", None, [th.zeros(1)]], ids=str)
def test_other_things_are_refused(other: Any) -> None:
    with pytest.raises(TypeError, match=f"got {type(other).__name__}"):
        map_tensors(lambda values: values, {"a": (other,)})


@pytest.mark.parametrize(
    "chosen", [slice(1, 4), th.tensor([5, 0]), th.tensor([True, False] * 3)], ids=str
)
def test_rows_are_those_of_every_tensor(chosen: Any) -> None:
    whole, part = tree(), rows(tree(), chosen)
    assert type(part["record"]) is Record
    assert th.equal(part["record"].latents, whole["record"].latents[chosen])
    assert th.equal(part["record"].more["a"], whole["record"].more["a"][chosen])
    assert th.equal(part["pair"][1], whole["pair"][1][chosen])


def test_every_tensor_is_found() -> None:
    assert sum(tensor.nbytes for tensor in tensors(tree(6))) == 6 * (4 + 3 * 8)


@pytest.mark.parametrize("n", [1, 8192, 20_000])
def test_chunks_cover_all_rows_in_order(n: int) -> None:
    sizes: list[int] = []

    def total(part: dict[str, Any]) -> th.Tensor:
        sizes.append(len(part["pair"][0]))
        return th.stack([part["record"].latents, part["pair"][0].float()], dim=1)

    found = in_chunks(total, tree(n), batch_size=64)
    assert sum(sizes) == n
    assert (len(sizes) > 1) == (n == 20_000)
    assert th.equal(found, th.arange(n).float().unsqueeze(1).expand(n, 2))


def test_chunks_are_evaluated_without_gradients() -> None:
    weight = th.ones((), requires_grad=True)
    assert not in_chunks(lambda x: weight * x, th.ones(3), batch_size=2).requires_grad
