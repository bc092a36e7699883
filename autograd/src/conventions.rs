//! Conventions: values and gradients at ties, kinks and the edges of domains.
//!
//! Where a function has no derivative, its operation returns the value and gradients below. A gradient is that of each
//! input for an output gradient of ones. Semicolons separate inputs. A test reads this table and evaluates every row in
//! `f32` and `f64`, with the gradient recorded and not recorded.
//!
//! The rules behind the table:
//!
//! * NaN propagates, unless the result does not depend on it.
//! * Tied elements share the gradient evenly. `max_pool2d` is an exception: the first of equal elements, in row-major
//!   order, gets all of it.
//! * A step has gradient 0.
//! * A kink has the gradient of the side that its formula takes.
//! * Where infinity times 0 would be NaN but a limit exists, the value is that limit. Second derivatives follow this
//!   rule too.
//!
//! ## Kinks and steps
//!
//! | operation | at | value | gradient | remark |
//! |---|---|---|---|---|
//! | `abs(x)` | `0` | `0` | `0` | the mean of both sides |
//! | `sign(x)` | `0` | `0` | `0` | 0 everywhere else too |
//! | `sign(x)` | `NaN` | `NaN` | `0` | |
//! | `relu(x)` | `0` | `0` | `0` | the side below |
//! | `leaky_relu(x, 0.1)` | `0` | `0` | `0.1` | the side below |
//! | `elu(x, 1.5)` | `0` | `0` | `1.5` | the side below |
//! | `clamp(x, -1, 2)` | `2` | `2` | `1` | the limits belong to the inside |
//! | `clamp(x, -1, 2)` | `-1` | `-1` | `1` | |
//! | `clamp(x, -1, 2)` | `3` | `2` | `0` | |
//! | `clamp(x, -1, 2)` | `NaN` | `NaN` | `1` | |
//! | `floor(x)` | `2` | `2` | `0` | 0 everywhere |
//! | `ceil(x)` | `2` | `2` | `0` | |
//! | `round(x)` | `0.5` | `0` | `0` | ties go to the even number |
//! | `round(x)` | `1.5` | `2` | `0` | |
//! | `absolute_error(a, b)` | `1; 1` | `0` | `0; 0` | |
//! | `huber(a, b, 2)` | `2; 0` | `2` | `2; -2` | both sides agree |
//! | `smooth_l1(a, b, 0)` | `1; 1` | `0` | `0; 0` | |
//!
//! ## Ties and choices
//!
//! | operation | at | value | gradient | remark |
//! |---|---|---|---|---|
//! | `maximum(a, b)` | `2; 2` | `2` | `0.5; 0.5` | shared evenly |
//! | `maximum(a, b)` | `NaN; 1` | `NaN` | `0.5; 0.5` | NaN wins |
//! | `minimum(a, b)` | `2; 2` | `2` | `0.5; 0.5` | |
//! | `minimum(a, b)` | `1; NaN` | `NaN` | `0.5; 0.5` | |
//! | `max(x)` | `[3, 1, 3]` | `3` | `[0.5, 0, 0.5]` | shared evenly, as PyTorch's `amax` |
//! | `min(x)` | `[1, 1, 1, 1, 3]` | `1` | `[0.25, 0.25, 0.25, 0.25, 0]` | |
//! | `max(x)` | `[1, NaN]` | `NaN` | `[0, 0]` | NaN wins; nothing equals it |
//! | `gt(a, b)` | `1; NaN` | `0` | `0; 0` | comparisons are masks |
//! | `elementwise_eq(a, b)` | `NaN; NaN` | `0` | `0; 0` | |
//! | `where(mask, a, b)` | `0; 1; 2` | `2` | `0; 0; 1` | the mask has no gradient |
//! | `if_positive(x, a, b)` | `NaN; 1; 2` | `2` | `0; 0; 1` | |
//!
//! ## Edges of domains
//!
//! | operation | at | value | gradient | remark |
//! |---|---|---|---|---|
//! | `sqrt(x)` | `0` | `0` | `inf` | |
//! | `sqrt(x)` | `-1` | `NaN` | `NaN` | |
//! | `rsqrt(x)` | `0` | `inf` | `-inf` | |
//! | `reciprocal(x)` | `0` | `inf` | `-inf` | |
//! | `div(a, b)` | `1; 0` | `inf` | `inf; -inf` | |
//! | `ln(x)` | `0` | `-inf` | `inf` | |
//! | `ln(x)` | `-1` | `NaN` | `-1` | 1 / x needs no logarithm |
//! | `log2(x)` | `0` | `-inf` | `inf` | |
//! | `ln1p(x)` | `-1` | `-inf` | `inf` | |
//! | `asin(x)` | `1` | `1.5707963267948966` | `inf` | |
//! | `acos(x)` | `-1` | `3.141592653589793` | `-inf` | |
//! | `asin(x)` | `2` | `NaN` | `NaN` | |
//! | `atan2(a, b)` | `0; 0` | `0` | `0; 0` | no direction, no gradient |
//! | `atan2(a, b)` | `0; -1` | `3.141592653589793` | `-1; 0` | the cut is reached from above |
//! | `hypot(a, b)` | `0; 0` | `0` | `0; 0` | no direction, no gradient |
//! | `logaddexp(a, b)` | `-inf; -inf` | `-inf` | `0.5; 0.5` | as of equal numbers |
//! | `remainder(a, b)` | `-1; 3` | `2` | `1; 1` | the sign of b, as in Python |
//! | `remainder(a, b)` | `6; 3` | `0` | `1; -2` | the slope of the branch above the step |
//! | `powi(x, 0)` | `0` | `1` | `0` | 0^0 = 1 |
//! | `powi(x, -1)` | `0` | `inf` | `-inf` | |
//! | `powf(x, 0.5)` | `0` | `0` | `inf` | |
//! | `powf(x, 0.5)` | `-1` | `NaN` | `NaN` | |
//! | `pow(a, b)` | `0; 0` | `1` | `0; 0` | 0^0 = 1, and constant on both sides |
//! | `pow(a, b)` | `0; 2` | `0` | `0; 0` | |
//! | `pow(a, b)` | `0; -1` | `inf` | `-inf; -inf` | |
//! | `pow(a, b)` | `-2; 3` | `-8` | `12; NaN` | whole exponents have powers, but no neighbours |
//! | `xlogy(a, b)` | `0; 0` | `0` | `0; 0` | 0 whatever b is |
//! | `xlogy(a, b)` | `0; -1` | `0` | `0; 0` | |
//! | `xlogy(a, b)` | `2; 0` | `-inf` | `-inf; inf` | |
//!
//! ## Zeros and no elements in reductions
//!
//! | operation | at | value | gradient | remark |
//! |---|---|---|---|---|
//! | `norm(x)` | `[0, 0]` | `0` | `[0, 0]` | |
//! | `norm_l1(x)` | `[0, -2]` | `2` | `[0, -1]` | |
//! | `std(x, 1)` | `[2, 2]` | `0` | `[0, 0]` | |
//! | `prod(x)` | `[0, 3]` | `0` | `[3, 0]` | nothing is divided |
//! | `prod(x)` | `[0, 3, 0]` | `0` | `[0, 0, 0]` | |
//! | `prod(x)` | `[inf, 2]` | `inf` | `[2, inf]` | |
//! | `prod(x)` | `[inf, 0]` | `NaN` | `[0, inf]` | |
//! | `cumprod(x)` | `[2, 0, 3]` | `[2, 0, 0]` | `[1, 8, 0]` | |
//! | `sum(x)` | `[]` | `0` | `[]` | |
//! | `prod(x)` | `[]` | `1` | `[]` | |
//! | `mean(x)` | `[]` | `NaN` | `[]` | |
//! | `logsumexp(x)` | `[]` | `-inf` | `[]` | |
//! | `logsumexp(x)` | `[-inf, -inf]` | `-inf` | `[0, 0]` | |
//! | `softmax(x)` | `[-inf, 0]` | `[0, 1]` | `[0, 0]` | |
//! | `softmax(x)` | `[-inf, -inf]` | `[NaN, NaN]` | `[NaN, NaN]` | no distribution |
//! | `cross_entropy(x, 0)` | `[0, -inf]` | `0` | `[0, 0]` | |
//! | `cross_entropy(x, 1)` | `[0, -inf]` | `inf` | `[1, -1]` | |
//!
//! ## Limits at infinity
//!
//! | operation | at | value | gradient | remark |
//! |---|---|---|---|---|
//! | `sigmoid(x)` | `-inf` | `0` | `0` | |
//! | `softplus(x)` | `inf` | `inf` | `1` | |
//! | `log_sigmoid(x)` | `-inf` | `-inf` | `1` | |
//! | `gelu(x)` | `-inf` | `0` | `0` | not NaN, as 0 times infinity would be |
//! | `gelu_tanh(x)` | `-inf` | `0` | `0` | |
//! | `silu(x)` | `-inf` | `0` | `0` | |
//! | `silu(x)` | `inf` | `inf` | `1` | |
//! | `tanh(x)` | `inf` | `1` | `0` | |
//! | `erf(x)` | `-inf` | `-1` | `0` | |
//! | `huber(a, b, 2)` | `inf; 0` | `inf` | `2; -2` | |
//! | `pow(a, b)` | `0.5; inf` | `0` | `0; 0` | the power vanishes faster than its exponent grows |
//! | `pow(a, b)` | `2; -inf` | `0` | `0; 0` | |
//! | `pow(a, b)` | `0; inf` | `0` | `0; 0` | |
//! | `pow(a, b)` | `inf; -0.5` | `0` | `0; 0` | |
//! | `pow(a, b)` | `inf; -inf` | `0` | `0; 0` | |
//! | `pow(a, b)` | `-inf; -inf` | `0` | `0; NaN` | |
//! | `powf(x, inf)` | `0.5` | `0` | `0` | |
//! | `powf(x, -inf)` | `2` | `0` | `0` | |
//! | `binary_cross_entropy_with_logits(a, b)` | `1000; 0` | `1000` | `1; -1000` | |
