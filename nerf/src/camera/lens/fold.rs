//! The domain of a distortion: how far from the axis it is monotonic, before the image folds back.

/// The number of coefficients of a distortion's determinant along a line from the axis.
const TERMS: usize = 23;
/// Bisections until the ends of an interval are neighbouring floats.
const HALVINGS: u32 = 54;

/// A distortion `x N(s) / D(s) + x (q . x) 2 + q s + t s` of points `x` with `s = |x|^2`, and its domain.
///
/// The domain extends from the axis to the first point at which the determinant of the Jacobian or `D` is not positive.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Domain {
    /// Coefficients of the numerator, from the constant one.
    pub(crate) numerator: [f64; 5],
    /// Coefficients of the denominator.
    pub(crate) denominator: [f64; 4],
    /// Tangential coefficients `[p2, p1]`, of x and y.
    pub(crate) tangential: [f64; 2],
    /// Thin-prism coefficients.
    pub(crate) prism: [f64; 2],
    /// The largest distance from the axis, for any distortion.
    pub(crate) limit: f64,
}

impl Domain {
    /// Returns true if the distortion depends on the distance from the axis alone.
    pub(crate) fn is_radial(&self) -> bool {
        self.tangential == [0.0; 2] && self.prism == [0.0; 2]
    }

    /// Returns true if the point is inside of the domain.
    pub(crate) fn holds(&self, [x, y]: [f64; 2]) -> bool {
        let r = x.hypot(y);
        r <= self.limit && (self.surely_holds(r) || self.edge([x / r, y / r], r).is_none())
    }

    /// Returns true if a cheap bound proves the Jacobian's symmetric part positive definite within the distance `r`.
    /// The map is invertible there.
    ///
    /// The eigenvalues of its radial part are `N / D` and `slope / D^2`. The smaller one is the latter at some smaller
    /// distance. The other terms subtract at most `(6 |q| + 2 |t|) r`.
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

    /// The distance from the axis to the end of the domain in the direction `e` of length 1; `None` if it is more than
    /// `end`.
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
    /// `qe`, `qn` and `te`, `tn` are the components of `q` and `t` along `e` and across it. The rows of the Jacobian
    /// along `e` and across it are `slope / D^2 + (6 qe + 2 te) r, 2 qn r` and `2 (qn + tn) r, N / D + 2 qe r`.
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

/// Rewrites a polynomial of `r^2` as one of `r`.
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

/// The Bernstein coefficients of a polynomial on `0..=end`, and their number. The values of the polynomial lie between
/// the least and the greatest of them.
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

/// Returns true if the Bernstein coefficients prove a polynomial positive on `0..=end`.
fn is_positive<const N: usize>(p: &[f64; N], end: f64) -> bool {
    let (b, count) = bernstein(p, end);
    b[..count].iter().all(|b| *b > 0.0)
}

/// The least number in `0..=end` at which a polynomial is not positive, or one just below it; `None` if there is none.
fn first_root<const N: usize>(p: &[f64; N], end: f64) -> Option<f64> {
    let end = end.min(f64::MAX);
    let (mut b, count) = bernstein(p, end);
    let share = descend(&mut b[..count], [0.0, 1.0], HALVINGS)?;
    // The precision of a root is relative to the interval searched, so a small root needs a smaller interval.
    let nearer = end * (2.0 * share + 1e-6);
    if share > 0.1 || !(nearer > f64::MIN_POSITIVE) {
        return Some(share * end);
    }
    // If the polynomial is positive on the nearer interval, rounding or overflow made the root.
    Some(first_root(p, nearer).unwrap_or(nearer))
}

/// [`first_root`] of a polynomial in Bernstein form on an interval, by de Casteljau's subdivision, the nearer half
/// first.
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
    // `b` now holds the coefficients of the second half.
    descend(first, [low, middle], halvings - 1).or_else(|| descend(b, [middle, high], halvings - 1))
}
