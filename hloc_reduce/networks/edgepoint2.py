"""EdgePoint2: a small network that finds and describes keypoints.

The architecture of the authors' code (github.com/HITCSC/EdgePoint2), with the names in its weights.
"""

import torch
from torch import nn
from torch.nn.functional import avg_pool2d, interpolate, relu

# channels at strides 2, 2, 4 and 16, and in the detector
CHANNELS = {
    "T": (8, 8, 16, 24, 8),
    "S": (8, 8, 24, 32, 8),
    "M": (8, 16, 32, 48, 8),
    "L": (8, 16, 48, 64, 8),
    "E": (16, 16, 48, 64, 16),
}


def _enlarge(maps: torch.Tensor, factor: int) -> torch.Tensor:
    return interpolate(maps, scale_factor=factor, mode="bilinear", align_corners=False)


class Block(nn.Module):
    """Convolution, batch normalization, ReLU."""

    def __init__(self, inputs: int, outputs: int, side: int = 3, stride: int = 1, groups: int = 1):
        super().__init__()
        self.layer = nn.Sequential(
            nn.Conv2d(inputs, outputs, side, stride, padding=1, groups=groups, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Map (B, C, H, W)."""
        return self.layer(maps)


class Residual(nn.Module):
    """Two convolutions with a skip connection."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.layer = nn.Sequential(
            nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
            nn.Conv2d(outputs, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
        )
        self.skip = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Map (B, C, H, W)."""
        return relu(self.layer(maps) + self.skip(maps))


class EdgePoint2(nn.Module):
    """The network.

    Args:
        size: of the channels, a key of `CHANNELS`.
        dim: dimension of the descriptors.
    """

    stride = 32  # the sides of its images are multiples of it
    last = "desc_head.2"  # the layer of the descriptors

    def __init__(self, size: str, dim: int):
        super().__init__()
        stem, fine, middle, coarse, detector = CHANNELS[size]
        joint = fine + middle + coarse
        self.norm = nn.InstanceNorm2d(1)
        self.block1 = nn.Sequential(Block(1, stem, 4, 2), Block(stem, fine), Residual(fine, fine))
        self.block2 = Residual(fine, middle)
        self.block3 = Residual(middle, coarse)
        self.desc_head = nn.Sequential(
            nn.Conv2d(joint, joint, 1),
            Block(joint, joint, groups=joint // 16),
            nn.Conv2d(joint, dim, 1),
        )
        self.conv1 = nn.Conv2d(fine, detector, 1)
        self.conv2 = nn.Conv2d(middle, detector, 1)
        self.conv3 = nn.Conv2d(coarse, detector, 1)
        self.score_head = nn.Sequential(
            nn.Conv2d(detector, detector, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(detector, detector, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(detector, 4, 3, padding=1),
            nn.PixelShuffle(2),
        )

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute descriptors and scores of all pixels.

        Args:
            image: (B, C, H, W) float32; H and W are multiples of `stride`.

        Returns:
            Descriptors (B, D, H / 4, W / 4), not normalized, and scores (B, 1, H, W), logits.
        """
        fine = self.block1(self.norm(image.mean(dim=1, keepdim=True)))
        quarter = avg_pool2d(fine, 2)
        middle = self.block2(avg_pool2d(quarter, 2))
        coarse = self.block3(avg_pool2d(middle, 4))
        joint = torch.cat([quarter, _enlarge(middle, 2), _enlarge(coarse, 8)], dim=1)
        scores = self.conv1(fine)
        scores = scores + _enlarge(self.conv2(middle), 4) + _enlarge(self.conv3(coarse), 16)
        return self.desc_head(joint), self.score_head(scores)
