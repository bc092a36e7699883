//! The domain of a distortion: how far from the axis it is monotonic, before the image folds back.

/// The highest power of the determinant of a distortion along a line from the axis, and one.
const TERMS: usize = 23;
/// Halvings of an interval until its ends are neighbouring numbers.
const HALVINGS: u32 = 54;

/// A distortion `x N(s) / D(s) + x (q . x) 2 + q s + t s` of places `x` with `s = |x|^2`, and where it is of use: from
/// the axis up to the first place at which its Jacobian's determinant or `D` is no longer positive.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Domain {
    /// Coefficients of the numerator, from that of 1.
    pub(crate) numerator: [f64; 5],
    /// Coefficients of the denominator.
    pub(crate) denominator: [f64; 4],
    /// Tangential coefficients `[p2, p1]`, of x and y.
    pub(crate) tangential: [f64; 2],
    /// Thin-prism coefficients.
    pub(crate) prism: [f64; 2],
    /// The farthest from the axis that a place may lie, whatever the distortion.
    pub(crate) limit: f64,
}

impl Domain {
    /// Whether places depend on the distance from the axis alone.
    pub(crate) fn is_radial(&self) -> bool {
        self.tangential == [0.0; 2] && self.prism == [0.0; 2]
    }

    /// Whether the distortion is of use at this place.
    pub(crate) fn holds(&self, [x, y]: [f64; 2]) -> bool {
        let r = x.hypot(y);
        r <= self.limit && (self.surely_holds(r) || self.edge([x / r, y / r], r).is_none())
    }

    /// Whether the Jacobian's symmetric part is surely positive definite within this distance of the axis, which costs
    /// little to know. The map is then in order there.
    ///
    /// The eigenvalues of its radial part are `N / D` and `slope / D^2`, of which the lesser is the latter at some
    /// smaller distance, and the other terms take away at most `(6 |q| + 2 |t|) r`.
    fn surely_holds(&self, r: f64) -> bool {
        let [q, t] = [self.tangential, self.prism].map(|[x, y]| x.hypot(y));
        let (lost, s) = ((6.0 * q + 2.0 * t) * r, r * r);
        let mut margin = self.slope();
        if lost > 0.0 {
            for (margin, square) in margin.iter_mut().zip(product::<8>(&self.denominator, &self.denominator)) {
                *margin -= lost * square;
            }
        }
        is_positive(&margin, s) && is_positive(&self.denominator, s)
    }

    /// `D^2` times the derivative of `r N / D` by `r`, as a polynomial of `s = r^2`: its coefficients are
    /// `(1 + 2 i - 2 j) N_i D_j`.
    fn slope(&self) -> [f64; 8] {
        let mut slope = [0.0; 8];
        for (j, d) in self.denominator.iter().enumerate().filter(|(_, d)| **d != 0.0) {
            for (i, n) in self.numerator.iter().enumerate() {
                slope[i + j] += (1.0 + 2.0 * i as f64 - 2.0 * j as f64) * n * d;
            }
        }
        slope
    }

    /// The distance from the axis up to which the distortion is of use in this direction, of length 1; `None` if that
    /// is more than `end`.
    pub(crate) fn edge(&self, e: [f64; 2], end: f64) -> Option<f64> {
        let s = end * end;
        let pole = first_root(&self.denominator, s).map(f64::sqrt);
        let fold = if self.is_radial() {
            first_root(&self.slope(), s).map(f64::sqrt)
        } else {
            first_root(&self.determinant(e), end)
        };
        match (pole, fold) {
            (Some(pole), Some(fold)) => Some(pole.min(fold)),
            (one, other) => one.or(other),
        }
    }

    /// `D^3` times the determinant of the Jacobian at the distance `r` in the direction `e`, as a polynomial of `r`.
    ///
    /// Along `e` and across, with the parts `qe`, `qn` of `q` and `te`, `tn` of `t`, the Jacobian's rows are
    /// `slope / D^2 + (6 qe + 2 te) r, 2 qn r` and `2 (qn + tn) r, N / D + 2 qe r`.
    fn determinant(&self, [x, y]: [f64; 2]) -> [f64; TERMS] {
        let parts = |[u, v]: [f64; 2]| [u * x + v * y, v * x - u * y];
        let ([qe, qn], [te, tn]) = (parts(self.tangential), parts(self.prism));
        let d = in_distance::<7>(&self.denominator);
        let square = product::<13>(&d, &d);
        let mut along = in_distance::<15>(&self.slope());
        for (k, square) in square.iter().enumerate() {
            along[k + 1] += (6.0 * qe + 2.0 * te) * square;
        }
        let mut across = in_distance::<9>(&self.numerator);
        for (k, d) in d.iter().enumerate() {
            across[k + 1] += 2.0 * qe * d;
        }
        let mut determinant = product::<TERMS>(&along, &across);
        for (k, cube) in product::<19>(&square, &d).iter().enumerate() {
            determinant[k + 2] -= 4.0 * qn * (qn + tn) * cube;
        }
        determinant
    }
}

/// A polynomial of `r^2` as one of `r`.
fn in_distance<const N: usize>(p: &[f64]) -> [f64; N] {
    std::array::from_fn(|k| if k % 2 == 0 { p[k / 2] } else { 0.0 })
}

/// The product of two polynomials.
fn product<const N: usize>(p: &[f64], q: &[f64]) -> [f64; N] {
    let mut out = [0.0; N];
    for (i, p) in p.iter().enumerate().filter(|(_, p)| **p != 0.0) {
        for (j, q) in q.iter().enumerate().filter(|(_, q)| **q != 0.0) {
            out[i + j] += p * q;
        }
    }
    out
}

/// The coefficients of a polynomial in Bernstein's form on `0..=end`, between the least and the greatest of which its
/// values lie, and how many they are.
fn bernstein<const N: usize>(p: &[f64; N], end: f64) -> ([f64; N], usize) {
    let degree = (1..N).rev().find(|&i| p[i] != 0.0).unwrap_or(0);
    let (mut b, mut power, mut choose) = (*p, 1.0, 1.0);
    for i in 0..=degree {
        b[i] *= power / choose;
        power *= end;
        choose *= (degree - i) as f64 / (i + 1) as f64;
    }
    for k in 1..=degree {
        for j in (k..=degree).rev() {
            b[j] += b[j - 1];
        }
    }
    (b, degree + 1)
}

/// Whether a polynomial is surely positive on `0..=end`.
fn is_positive<const N: usize>(p: &[f64; N], end: f64) -> bool {
    let (b, count) = bernstein(p, end);
    b[..count].iter().all(|b| *b > 0.0)
}

/// The least number in `0..=end` at which a polynomial is not positive, or one just below; `None` if there is none.
fn first_root<const N: usize>(p: &[f64; N], end: f64) -> Option<f64> {
    let end = end.min(f64::MAX);
    let (mut b, count) = bernstein(p, end);
    let share = descend(&mut b[..count], [0.0, 1.0], HALVINGS)?;
    // A root has the digits of the interval that it is looked for in.
    let nearer = end * (2.0 * share + 1e-6);
    if share > 0.1 || !(nearer > f64::MIN_POSITIVE) {
        return Some(share * end);
    }
    // What is positive on the whole of the nearer interval had no root here but by rounding or overflow.
    Some(first_root(p, nearer).unwrap_or(nearer))
}

/// [`first_root`] of a polynomial in Bernstein's form on an interval, the nearer half first (de Casteljau).
fn descend(b: &mut [f64], [low, high]: [f64; 2], halvings: u32) -> Option<f64> {
    if b.iter().all(|b| *b > 0.0) {
        return None;
    } else if halvings == 0 || !(b[0] > 0.0) {
        return Some(low);
    }
    let (mut store, count, middle) = ([0.0; TERMS], b.len(), 0.5 * (low + high));
    let first = &mut store[..count];
    for k in 0..count {
        first[k] = b[0];
        for j in 0..count - 1 - k {
            b[j] = 0.5 * (b[j] + b[j + 1]);
        }
    }
    // What is left of `b` is the second half: its last entry is the end, and each before it the mean of one step more.
    descend(first, [low, middle], halvings - 1).or_else(|| descend(b, [middle, high], halvings - 1))
}
