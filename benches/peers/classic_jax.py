"""The classic NeRF in JAX, the whole step compiled. Shapes: R rays, S samples a ray."""

import os
from functools import partial

import jax
import jax.numpy as jnp
import optax

PACKAGES = ("jax", "jaxlib", "optax", "numpy")

jax.config.update("jax_platforms", "cpu")


def encode(x, octaves):
    """(..., 3) -> (..., 3 + 6 octaves): x, then the sines, then the cosines of 2^k x."""
    scaled = (x[..., None, :] * 2.0 ** jnp.arange(octaves)[:, None]).reshape(*x.shape[:-1], -1)
    return jnp.concatenate((x, jnp.sin(scaled), jnp.cos(scaled)), -1)


def linear_init(key, inputs, outputs):
    """Uniform within 1 / sqrt(inputs), which is PyTorch's default."""
    bound = inputs**-0.5
    weight_key, bias_key = jax.random.split(key)
    return {
        "weight": jax.random.uniform(weight_key, (inputs, outputs), minval=-bound, maxval=bound),
        "bias": jax.random.uniform(bias_key, (outputs,), minval=-bound, maxval=bound),
    }


def linear(layer, x):
    return x @ layer["weight"] + layer["bias"]


def field_init(config, key):
    position = 3 + 6 * config.position_octaves
    direction = 3 + 6 * config.direction_octaves
    inputs = [position] + [config.width] * (config.depth - 1)
    inputs[config.skip] += position
    keys = iter(jax.random.split(key, config.depth + 4))
    return {
        "trunk": [linear_init(next(keys), n, config.width) for n in inputs],
        "density": linear_init(next(keys), config.width, 1),
        "feature": linear_init(next(keys), config.width, config.width),
        "view": linear_init(next(keys), config.width + direction, config.view_width),
        "colour": linear_init(next(keys), config.view_width, 3),
    }


def field(config, params, position, direction):
    """Encoded (R, S, 63) and (R, 27) -> density (R, S) and colour (R, S, 3)."""
    h = position
    for i, layer in enumerate(params["trunk"]):
        if i == config.skip:
            h = jnp.concatenate((h, position), -1)
        h = jax.nn.relu(linear(layer, h))
    density = jax.nn.softplus(linear(params["density"], h)[..., 0])
    direction = jnp.broadcast_to(direction[:, None], (*h.shape[:2], direction.shape[-1]))
    h = jax.nn.relu(linear(params["view"], jnp.concatenate((linear(params["feature"], h), direction), -1)))
    return density, jax.nn.sigmoid(linear(params["colour"], h))


def stratified(config, key, rays):
    """One uniform sample in each of equal intervals: (R, S)."""
    count = config.coarse_samples
    jitter = jax.random.uniform(key, (rays, count))
    return config.near + (config.far - config.near) / count * (jnp.arange(count) + jitter)


def importance(key, t, weights, count):
    """Draw `count` distances by the inverse of the piecewise linear CDF of `weights`: (R, S) -> (R, count)."""
    bins = 0.5 * (t[:, 1:] + t[:, :-1])
    pdf = weights[:, 1:-1] + 1e-5
    cdf = jnp.pad(jnp.cumsum(pdf / pdf.sum(-1, keepdims=True), -1), ((0, 0), (1, 0)))
    u = jax.random.uniform(key, (len(t), count))
    return jax.vmap(jnp.interp)(u, cdf, bins)


def composite(density, colour, t, far):
    """Colour (R, 3) over white and the weights (R, S)."""
    depth = density * jnp.diff(t, append=jnp.full((len(t), 1), far))
    weights = jnp.exp(depth - jnp.cumsum(depth, -1)) * -jnp.expm1(-depth)
    return (weights[..., None] * colour).sum(1) + (1.0 - weights.sum(-1, keepdims=True)), weights


def render(config, params, key, origins, directions):
    coarse_key, fine_key = jax.random.split(key)
    encoded_direction = encode(directions, config.direction_octaves)

    def shade(params, t):
        points = origins[:, None] + t[..., None] * directions[:, None]
        encoded = encode(points, config.position_octaves)
        return composite(*field(config, params, encoded, encoded_direction), t, config.far)

    t = stratified(config, coarse_key, len(origins))
    coarse_colour, weights = shade(params["coarse"], t)
    extra = importance(fine_key, t, jax.lax.stop_gradient(weights), config.fine_samples)
    t = jnp.sort(jnp.concatenate((t, extra), -1), -1)
    return coarse_colour, shade(params["fine"], t)[0]


def loss_of(config, params, key, origins, directions, target):
    coarse_colour, fine_colour = render(config, params, key, origins, directions)
    return jnp.mean((coarse_colour - target) ** 2) + jnp.mean((fine_colour - target) ** 2)


def use_threads(count):
    """JAX sizes its thread pool at its first operation by the cores the process may use; it has no setting for it."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


def prepare(config, arrays, threads):
    use_threads(threads)
    coarse_key, fine_key, key = jax.random.split(jax.random.key(0), 3)
    params = {"coarse": field_init(config, coarse_key), "fine": field_init(config, fine_key)}
    return params, key, [jnp.asarray(a) for a in arrays]


def training_step(config, *arrays, threads):
    params, key, rays = prepare(config, arrays, threads)
    adam = optax.adam(config.learning_rate)
    state = params, adam.init(params), key

    @partial(jax.jit, donate_argnums=0)
    def update(state, rays):
        params, moments, key = state
        key, now = jax.random.split(key)
        loss, gradient = jax.value_and_grad(partial(loss_of, config))(params, now, *rays)
        change, moments = adam.update(gradient, moments)
        return (optax.apply_updates(params, change), moments, key), loss

    def step():
        nonlocal state
        state, loss = jax.block_until_ready(update(state, rays))
        return loss.item()

    return step


def forward_step(config, *arrays, threads):
    params, key, rays = prepare(config, arrays, threads)

    @jax.jit
    def forward(params, key, rays):
        key, now = jax.random.split(key)
        return key, loss_of(config, params, now, *rays)

    def step():
        nonlocal key
        key, loss = jax.block_until_ready(forward(params, key, rays))
        return loss.item()

    return step
