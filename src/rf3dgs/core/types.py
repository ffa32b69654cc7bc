"""Shape aliases: jaxtyping annotations with the dimension names used throughout."""

from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

Vector = Float[Tensor, "*batch 3"]
Quaternion = Float[Tensor, "*batch 4"]
Matrix = Float[Tensor, "*batch 3 3"]
Picture = Float[Tensor, "row col channel"]

__all__ = ["Bool", "Complex", "Float", "Int", "Matrix", "Picture", "Quaternion", "Tensor", "Vector"]
