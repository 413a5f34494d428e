//! The world inside a cube of two units, and all that lies around it in the shell between two and four.

/// Where the scene lies: what is inside is kept as it is, what is outside is drawn in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Space {
    /// Center of the inner cube in world, metres.
    pub center_m: [f64; 3],
    /// Half an edge of the inner cube, metres.
    pub radius_m: f64,
}

impl Space {
    /// A point in world, metres, to the unit cube: the inner cube fills its middle half along each axis.
    ///
    /// Source: Barron et al. 2022, equation 10, with the largest coordinate in place of the length, so that cubes stay cubes.
    pub fn contract(&self, world_m: [f64; 3]) -> [f64; 3] {
        let scaled = self.scaled(world_m);
        let (_, largest) = largest(scaled);
        if largest <= 1.0 {
            return scaled.map(|x| (x + 2.0) / 4.0);
        }
        scaled.map(|x| (x / largest * (2.0 - 1.0 / largest) + 2.0) / 4.0)
    }

    /// Carries a slope towards the contracted point back to the point in world.
    pub fn contract_backward(&self, world_m: [f64; 3], upstream: [f64; 3]) -> [f64; 3] {
        let scaled = self.scaled(world_m);
        let (axis, most) = largest(scaled);
        if most <= 1.0 {
            return upstream.map(|v| v / (4.0 * self.radius_m));
        }
        // x -> x (2 m - 1) / m^2, where m is the largest coordinate.
        let factor = (2.0 * most - 1.0) / (most * most);
        let by_most = (2.0 - 2.0 * most) / (most * most * most);
        let along: f64 = scaled.iter().zip(upstream).map(|(x, v)| x * v).sum();
        let mut slope = upstream.map(|v| v * factor);
        slope[axis] += along * by_most * scaled[axis].signum();
        slope.map(|v| v / (4.0 * self.radius_m))
    }

    fn scaled(&self, world_m: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|axis| (world_m[axis] - self.center_m[axis]) / self.radius_m)
    }
}

/// The axis of the largest coordinate, and its size.
fn largest(point: [f64; 3]) -> (usize, f64) {
    let larger =
        |best: (usize, f64), axis: usize| if point[axis].abs() > best.1 { (axis, point[axis].abs()) } else { best };
    (0..3).fold((0, 0.0), larger)
}
