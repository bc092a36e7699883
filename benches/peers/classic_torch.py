"""The classic NeRF in eager PyTorch. Shapes: R rays, S samples a ray."""

import torch
from torch import nn
from torch.nn import functional as F

PACKAGES = ("torch", "numpy")


def encode(x, octaves):
    """(..., 3) -> (..., 3 + 6 octaves): x, then the sines, then the cosines of 2^k x."""
    scaled = (x.unsqueeze(-2) * 2.0 ** torch.arange(octaves).unsqueeze(-1)).flatten(-2)
    return torch.cat((x, scaled.sin(), scaled.cos()), -1)


class Field(nn.Module):
    def __init__(self, config):
        super().__init__()
        position = 3 + 6 * config.position_octaves
        direction = 3 + 6 * config.direction_octaves
        inputs = [position] + [config.width] * (config.depth - 1)
        inputs[config.skip] += position
        self.skip = config.skip
        self.trunk = nn.ModuleList(nn.Linear(n, config.width) for n in inputs)
        self.density = nn.Linear(config.width, 1)
        self.feature = nn.Linear(config.width, config.width)
        self.view = nn.Linear(config.width + direction, config.view_width)
        self.colour = nn.Linear(config.view_width, 3)

    def forward(self, position, direction):
        """Encoded (R, S, 63) and (R, 27) -> density (R, S) and colour (R, S, 3)."""
        h = position
        for i, layer in enumerate(self.trunk):
            if i == self.skip:
                h = torch.cat((h, position), -1)
            h = layer(h).relu_()
        density = F.softplus(self.density(h).squeeze(-1))
        direction = direction.unsqueeze(1).expand(-1, h.shape[1], -1)
        h = self.view(torch.cat((self.feature(h), direction), -1)).relu_()
        return density, self.colour(h).sigmoid()


def stratified(config, rays):
    """One uniform sample in each of equal intervals: (R, S)."""
    count = config.coarse_samples
    return config.near + (config.far - config.near) / count * (torch.arange(count) + torch.rand(rays, count))


def importance(t, weights, count):
    """Draw `count` distances by the inverse of the piecewise linear CDF of `weights`: (R, S) -> (R, count)."""
    bins = 0.5 * (t[:, 1:] + t[:, :-1])
    pdf = weights[:, 1:-1] + 1e-5
    cdf = F.pad((pdf / pdf.sum(-1, keepdim=True)).cumsum(-1), (1, 0))
    u = torch.rand(len(t), count)
    above = torch.searchsorted(cdf, u, right=True).clamp_(1, cdf.shape[-1] - 1)
    below = above - 1
    cdf_below, bin_below = cdf.gather(-1, below), bins.gather(-1, below)
    fraction = (u - cdf_below) / (cdf.gather(-1, above) - cdf_below)
    return bin_below + fraction.clamp_(0.0, 1.0) * (bins.gather(-1, above) - bin_below)


def composite(density, colour, t, far):
    """Colour (R, 3) over white and the weights (R, S)."""
    depth = density * torch.diff(t, append=t.new_full((len(t), 1), far))
    weights = torch.exp(depth - depth.cumsum(-1)) * -torch.expm1(-depth)
    return (weights.unsqueeze(-1) * colour).sum(1) + (1.0 - weights.sum(-1, keepdim=True)), weights


def render(config, coarse, fine, origins, directions):
    encoded_direction = encode(directions, config.direction_octaves)

    def shade(field, t):
        points = origins.unsqueeze(1) + t.unsqueeze(-1) * directions.unsqueeze(1)
        return composite(*field(encode(points, config.position_octaves), encoded_direction), t, config.far)

    t = stratified(config, len(origins))
    coarse_colour, weights = shade(coarse, t)
    extra = importance(t, weights.detach(), config.fine_samples)
    t = torch.cat((t, extra), -1).sort(-1).values
    return coarse_colour, shade(fine, t)[0]


def prepare(config, arrays, threads):
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    return Field(config), Field(config), *map(torch.from_numpy, arrays)


def loss_of(config, coarse, fine, origins, directions, target):
    coarse_colour, fine_colour = render(config, coarse, fine, origins, directions)
    return F.mse_loss(coarse_colour, target) + F.mse_loss(fine_colour, target)


def training_step(config, *arrays, threads):
    coarse, fine, *rays = prepare(config, arrays, threads)
    adam = torch.optim.Adam([*coarse.parameters(), *fine.parameters()], lr=config.learning_rate, fused=True)

    def step():
        adam.zero_grad()
        loss = loss_of(config, coarse, fine, *rays)
        loss.backward()
        adam.step()
        return loss.item()

    return step


def forward_step(config, *arrays, threads):
    coarse, fine, *rays = prepare(config, arrays, threads)

    @torch.inference_mode()
    def step():
        return loss_of(config, coarse, fine, *rays).item()

    return step
