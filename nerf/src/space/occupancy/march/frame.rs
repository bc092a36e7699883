//! Rays in units of cells, and lookup of the cell that holds a point.

use super::super::lattice::{EDGE, Lattice};
use super::spacing::whole;

/// A ray in units of the smallest cells, mirrored so that no coordinate falls along it.
///
/// Mirroring leaves one case of each comparison. A sample on a face belongs to the cell that the ray enters.
pub(super) struct LatticeRay {
    origin: [f32; 3],
    slope: [f32; 3],
    /// Reciprocals of the slopes; infinite for a slope of 0.
    inverse: [f32; 3],
    /// Bit `a` is set if axis `a` is mirrored.
    pub octant: usize,
    /// The distances between which it is marched, in scene units.
    pub span: [f32; 2],
}

impl LatticeRay {
    /// The part of a ray's span that is in the box; `None` if there is none, or a number is not finite.
    #[inline(always)]
    pub fn new(origin: [f32; 3], direction: [f32; 3], span: [f32; 2], frame: &Frame) -> Option<Self> {
        let mut ray = LatticeRay { origin: [0.0; 3], slope: [0.0; 3], inverse: [0.0; 3], octant: 0, span };
        let mut sum = 0.0;
        for axis in 0..3 {
            // Far from the origin the difference would lose its digits in f32.
            let place = (f64::from(origin[axis]) - frame.low[axis]) * frame.scale[axis];
            let slope = f64::from(direction[axis]) * frame.scale[axis];
            let mirrored = slope < 0.0;
            ray.octant |= usize::from(mirrored) << axis;
            ray.origin[axis] = (if mirrored { frame.size - place } else { place }) as f32;
            ray.slope[axis] = slope.abs() as f32;
            if ray.slope[axis] == 0.0 && place <= frame.size {
                // The upper face belongs to the box but to no cell.
                ray.origin[axis] = ray.origin[axis].min((frame.size as f32).next_down());
            }
            ray.inverse[axis] = 1.0 / ray.slope[axis];
            sum += ray.origin[axis] + ray.slope[axis];
        }
        // Checked first, since maxima ignore NaN.
        if !(sum.is_finite() && span[0] < span[1]) {
            return None;
        }
        let (enter, leave) = (ray.reaches([0.0; 3]), ray.reaches([frame.size as f32; 3]));
        let [near, far] = &mut ray.span;
        *near = near.max(0.0);
        for axis in 0..3 {
            (*near, *far) = (near.max(enter[axis]), far.min(leave[axis]));
        }
        (*near < *far).then_some(ray)
    }

    /// The point at distance `t`. Fused, so that it never falls with rising `t`.
    #[inline(always)]
    pub fn at(&self, t: f32) -> [f32; 3] {
        std::array::from_fn(
            #[inline(always)]
            |axis| t.mul_add(self.slope[axis], self.origin[axis]),
        )
    }

    /// The distances at which the ray reaches a plane across each axis.
    #[inline(always)]
    pub fn reaches(&self, planes: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(
            #[inline(always)]
            |axis| (planes[axis] - self.origin[axis]) * self.inverse[axis],
        )
    }
}

/// The grid's geometry, common to all rays of a batch.
pub(super) struct Frame {
    /// Lower corner of the outermost cascade, in scene units.
    low: [f64; 3],
    /// Smallest cells per scene unit.
    scale: [f64; 3],
    /// Smallest cells along the outermost box.
    pub size: f64,
    pub cells: i32,
    /// Half the cells of a cascade.
    half: i32,
    pub cascades: u32,
    /// Blocks along a cascade.
    side: i32,
}

impl Frame {
    pub fn new(lattice: &Lattice) -> Self {
        let [low, high] = lattice.extent(lattice.cascades - 1);
        // At most 2^17, which is exact in every number type here.
        let cells = lattice.resolution << (lattice.cascades - 1);
        Frame {
            low: low.to_array(),
            scale: (cells as f64 / (high - low)).to_array(),
            size: cells as f64,
            cells: cells as i32,
            half: (lattice.resolution / 2) as i32,
            cascades: lattice.cascades as u32,
            side: lattice.side() as i32,
        }
    }

    /// The cascade, the block and the cell in the block that hold a point; beyond the upper faces the last ones.
    #[inline(always)]
    pub fn locate<const NESTED: bool>(&self, point: [f32; 3]) -> (u32, [i32; 3], [i32; 3]) {
        let last = (self.cells - 1) as f32;
        let finest = point.map(
            #[inline(always)]
            |x| whole(x, last),
        );
        let cascade = if NESTED { self.cascade(finest) } else { 0 };
        let corner = if NESTED { self.corner(cascade) } else { 0 };
        let (mut block, mut cell) = ([0; 3], [0; 3]);
        for axis in 0..3 {
            let place = (finest[axis] - corner) >> cascade;
            (block[axis], cell[axis]) = (place >> 2, place & 3);
        }
        (cascade, block, cell)
    }

    /// The smallest cascade that contains a cell of the finest size.
    #[inline(always)]
    fn cascade(&self, cell: [i32; 3]) -> u32 {
        let mut radius = 0;
        for x in cell {
            radius = radius.max(x.max(self.cells - 1 - x) - self.cells / 2);
        }
        // The logarithm of the distance in half cascades is the exponent of a float. It is taken at the middle of the
        // cell, away from borders.
        let doublings = (radius as f32 + 0.5) / self.half as f32;
        ((doublings.to_bits() >> 23) as i32 - 126).max(0) as u32
    }

    /// The lower corner of a cascade.
    #[inline(always)]
    fn corner(&self, cascade: u32) -> i32 {
        self.cells / 2 - (self.half << cascade)
    }

    /// The lower face of a block of a cascade.
    #[inline(always)]
    pub fn face(&self, cascade: u32, block: i32) -> f32 {
        (self.corner(cascade) + ((block * EDGE as i32) << cascade)) as f32
    }
}

/// The numbering of a mirrored ray's blocks and cells: downwards along mirrored axes.
pub(super) struct Numbering {
    strides: [i32; 3],
    first: i32,
    blocks: i32,
    /// The bits to flip in the number of a cell.
    flip: u32,
}

impl Numbering {
    #[inline(always)]
    pub fn new(frame: &Frame, octant: usize) -> Self {
        let mut strides = [1, frame.side, frame.side * frame.side];
        let (blocks, mut first, mut flip) = (frame.side * strides[2], 0, 0);
        for axis in 0..3 {
            if octant >> axis & 1 == 1 {
                first += strides[axis] * (frame.side - 1);
                strides[axis] = -strides[axis];
                flip |= (EDGE as u32 - 1) << (2 * axis);
            }
        }
        Numbering { strides, first, blocks, flip }
    }

    #[inline(always)]
    pub fn word(&self, cascade: u32, block: [i32; 3]) -> usize {
        let [x, y, z] = self.strides;
        (self.first + cascade as i32 * self.blocks + x * block[0] + y * block[1] + z * block[2]) as usize
    }

    #[inline(always)]
    pub fn bit(&self, cell: [i32; 3]) -> u32 {
        (cell[0] | cell[1] << 2 | cell[2] << 4) as u32 ^ self.flip
    }
}
