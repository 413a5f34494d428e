//! Axes: ranges, ticks and number formats.

/// How values map to positions.
#[derive(Clone, Debug, PartialEq)]
pub enum Scale {
    /// Linear.
    Linear,
    /// Logarithmic, for values above 0.
    Log,
    /// Evenly spaced levels, given in ascending order. Positions between two levels are
    /// interpolated linearly.
    Levels(Vec<f64>),
}

/// One axis.
#[derive(Clone, Debug)]
pub struct Axis {
    /// Quantity and unit.
    pub label: String,
    /// How values are mapped to positions.
    pub scale: Scale,
    /// Tick values. If the list is empty, ticks are chosen automatically. Ticks outside the data
    /// are omitted.
    pub ticks: Vec<f64>,
}

/// An axis with the range of its data.
#[derive(Clone, Debug)]
pub(super) struct AxisRange {
    scale: Scale,
    low: f64,
    high: f64,
    /// Tick values and their labels.
    pub(super) ticks: Vec<(f64, String)>,
}

/// Minimum range of a linear axis, so that noise does not look like a trend.
const MIN_SPAN: f64 = 1.0;
/// Approximate number of ticks of an axis.
const N_TICKS: f64 = 7.0;

impl Axis {
    /// Returns the axis with a range that contains `values`.
    pub(super) fn span(&self, values: impl Iterator<Item = f64>) -> AxisRange {
        let mut low = f64::INFINITY;
        let mut high = f64::NEG_INFINITY;
        for value in values.filter(|value| value.is_finite()) {
            low = low.min(value);
            high = high.max(value);
        }
        // Without values, any range draws an empty chart. It is above 0 for a logarithmic axis.
        if low > high {
            low = 1.0;
            high = 2.0;
        }
        // Space at both ends keeps the outermost dots inside the plot.
        let (low, high) = match &self.scale {
            Scale::Linear => {
                let missing = (MIN_SPAN - (high - low)).max(0.0) / 2.0;
                let padding = 0.05 * (high - low).max(MIN_SPAN);
                (low - missing - padding, high + missing + padding)
            }
            Scale::Log => {
                let padding = (high / low).powf(0.03).max(1.03);
                (low / padding, high * padding)
            }
            Scale::Levels(_) => (low, high),
        };
        let inside = |value: &f64| (low..=high).contains(value);
        let ticks: Vec<f64> = match &self.scale {
            _ if !self.ticks.is_empty() => self.ticks.iter().copied().filter(inside).collect(),
            Scale::Linear => linear_ticks(low, high),
            Scale::Log => log_ticks(low, high),
            Scale::Levels(levels) => levels.clone(),
        };
        let ticks = ticks
            .into_iter()
            .map(|value| (value, compact_number(value)))
            .collect();
        AxisRange {
            scale: self.scale.clone(),
            low,
            high,
            ticks,
        }
    }
}

impl AxisRange {
    /// Relative position of a value, from 0 at the low end to 1 at the high end.
    pub(super) fn frac(&self, value: f64) -> f64 {
        match &self.scale {
            Scale::Linear => (value - self.low) / (self.high - self.low),
            Scale::Log => (value / self.low).ln() / (self.high / self.low).ln(),
            Scale::Levels(levels) => {
                // Leaves half a step at both ends.
                (level_position(levels, value) + 0.5) / levels.len().max(1) as f64
            }
        }
    }
}

/// Position of a value among levels. It is 0 at the first level, 1 at the second level, and so on.
fn level_position(levels: &[f64], value: f64) -> f64 {
    if levels.len() < 2 {
        return 0.0;
    }
    let next = levels
        .partition_point(|level| *level < value)
        .clamp(1, levels.len() - 1);
    let before = levels[next - 1];
    let after = levels[next];
    (next - 1) as f64 + (value - before) / (after - before)
}

/// Ticks at multiples of 1, 2 or 5 times a power of ten.
fn linear_ticks(low: f64, high: f64) -> Vec<f64> {
    let rough = (high - low) / N_TICKS;
    let power = 10.0_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .map(|factor| factor * power)
        .into_iter()
        .find(|step| *step >= rough);
    let step = step.unwrap_or(10.0 * power);
    let mut ticks = Vec::new();
    // Ticks are computed as products. Repeated sums would accumulate rounding errors, which could
    // remove the last tick.
    let mut n = (low / step).ceil();
    while n * step <= high {
        ticks.push(n * step);
        n += 1.0;
    }
    ticks
}

/// Ticks at 1, 2 and 5 times powers of ten. If there are too many ticks, only the powers are used.
/// If there are too few, all multiples of the powers are used.
fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    let mut powers = Vec::new();
    let mut power = 10.0_f64.powf(low.log10().floor());
    while power <= high {
        powers.push(power);
        power *= 10.0;
    }
    let all = powers
        .iter()
        .flat_map(|power| [*power, 2.0 * power, 5.0 * power]);
    let all: Vec<f64> = all.filter(|tick| (low..=high).contains(tick)).collect();
    // Within less than a decade, 1, 2 and 5 may give a single tick, from which no scale can be
    // read.
    if all.len() < 3 {
        let multiples = powers
            .iter()
            .flat_map(|power| (1..10).map(move |n| f64::from(n) * power));
        return multiples
            .filter(|tick| (low..=high).contains(tick))
            .collect();
    }
    if all.len() as f64 <= 2.0 * N_TICKS {
        all
    } else {
        powers.into_iter().filter(|tick| *tick >= low).collect()
    }
}

/// Formats a number for an axis. It has at most three decimals, and thousands are written as k and
/// millions as M.
pub fn compact_number(value: f64) -> String {
    let (value, suffix) = match value.abs() {
        size if size >= 1e6 => (value / 1e6, "M"),
        size if size >= 1e3 => (value / 1e3, "k"),
        _ => (value, ""),
    };
    let text = format!("{value:.3}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    format!("{}{suffix}", if text == "-0" { "0" } else { text })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(scale: Scale) -> Axis {
        Axis {
            label: String::new(),
            scale,
            ticks: Vec::new(),
        }
    }

    #[test]
    fn axis_numbers_are_compact() {
        let labels = [0.25, 60.0, 0.1, 512_000.0, 1e6, 1500.0, -0.0001, 25.0].map(compact_number);
        assert_eq!(
            labels,
            ["0.25", "60", "0.1", "512k", "1M", "1.5k", "0", "25"]
        );
    }

    #[test]
    fn ticks_are_round_and_within_range() {
        let labels = |span: AxisRange| -> Vec<String> {
            span.ticks.into_iter().map(|(_, label)| label).collect()
        };
        assert_eq!(
            labels(axis(Scale::Linear).span([21.0, 33.0].into_iter())),
            ["22", "24", "26", "28", "30", "32"]
        );
        let log = labels(axis(Scale::Log).span([1900.0, 70_000.0].into_iter()));
        assert_eq!(log, ["2k", "5k", "10k", "20k", "50k"]);
        assert_eq!(
            labels(axis(Scale::Log).span([3.1, 7.4].into_iter())),
            ["4", "5", "6", "7"]
        );
        let flat = axis(Scale::Linear).span([24.0, 24.0].into_iter());
        assert!(
            flat.ticks.len() >= 3 && (flat.frac(24.0) - 0.5).abs() < 1e-9,
            "{flat:?}"
        );
    }

    #[test]
    fn levels_are_evenly_spaced() {
        let span = axis(Scale::Levels(vec![0.0, 1.0, 10.0, 50.0])).span([0.0, 50.0].into_iter());
        let at = |value: f64| span.frac(value);
        assert_eq!(
            [at(0.0), at(1.0), at(10.0), at(50.0)],
            [0.125, 0.375, 0.625, 0.875]
        );
        assert_eq!(at(30.0), 0.75);
        assert!(
            axis(Scale::Levels(Vec::new()))
                .span([].into_iter())
                .frac(1.0)
                .is_finite()
        );
    }

    #[test]
    fn log_axis_preserves_ratios() {
        let span = axis(Scale::Log).span([1.0, 16.0].into_iter());
        let step = span.frac(2.0) - span.frac(1.0);
        assert!((span.frac(16.0) - span.frac(8.0) - step).abs() < 1e-12);
        assert!(span.frac(1.0) > 0.0 && span.frac(16.0) < 1.0);
    }
}
