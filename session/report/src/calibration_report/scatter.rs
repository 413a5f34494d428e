//! Scatter plots with equal scales, as SVG.

use crate::chart::drawing::escaped;
use std::fmt::Write;

/// A point of a scatter plot.
pub(super) struct ScatterPoint {
    pub(super) name: String,
    pub(super) at: [f64; 2],
    pub(super) is_outlier: bool,
}

/// Points around the origin. Outliers beyond the range are drawn at its edge.
///
/// * `axes`: labels with units.
pub(super) fn svg(axes: [&str; 2], points: &[ScatterPoint]) -> String {
    const SIDE: f64 = 320.0;
    const CENTER: f64 = SIDE / 2.0;
    /// Distance of the outer ticks from the center. The rest of the side is for labels.
    const REACH: f64 = 125.0;
    // Outliers do not determine the scale, because they would hide the scatter of the others.
    let used = points
        .iter()
        .filter(|point| !point.is_outlier)
        .flat_map(|point| point.at);
    let step = tick_step(used.map(f64::abs).fold(1e-6, f64::max));
    let range = 2.0 * step;
    // Points outside the range are drawn beyond the last tick, to distinguish them from points on
    // the tick.
    let to = |value: f64| REACH * (value / range).clamp(-1.12, 1.12);
    let mut shapes = String::new();
    for tick in [-2.0, -1.0, 0.0, 1.0, 2.0] {
        let at = CENTER + REACH * tick / 2.0;
        let low = CENTER - REACH;
        let high = CENTER + REACH;
        let label = short(tick * step);
        writeln!(
            shapes,
            "<path class=\"gridline\" d=\"M{at:.1} {low}V{high}M{low} {at:.1}H{high}\"/>\
             <text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{label}</text>\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\" dominant-baseline=\"central\">{}</text>",
            high + 16.0,
            low - 5.0,
            at,
            short(-tick * step)
        )
        .expect("writing to a string cannot fail");
    }
    for ScatterPoint {
        name,
        at: [x, y],
        is_outlier,
    } in points
    {
        let class = if *is_outlier {
            "point outlier"
        } else {
            "point"
        };
        writeln!(
            shapes,
            "<circle class=\"{class}\" cx=\"{:.1}\" cy=\"{:.1}\" r=\"4\"><title>{}: {x:.2}, {y:.2}</title></circle>",
            CENTER + to(*x),
            CENTER - to(*y),
            escaped(name)
        )
        .expect("writing to a string cannot fail");
    }
    let [across, up] = axes.map(escaped);
    format!(
        "<svg class=\"scatter\" role=\"img\" aria-label=\"{across} and {up}\" viewBox=\"-14 0 {} {}\">\n{shapes}\
         <text class=\"axis\" x=\"{CENTER}\" y=\"{}\" text-anchor=\"middle\">{across}</text>\
         <text class=\"axis\" x=\"-4\" y=\"{CENTER}\" text-anchor=\"middle\" transform=\"rotate(-90 -4 {CENTER})\">{up}</text>\
         </svg>\n",
        SIDE + 10.0,
        SIDE + 16.0,
        SIDE + 8.0
    )
}

/// The smallest round tick step such that two steps cover `largest`.
fn tick_step(largest: f64) -> f64 {
    // There are two ticks on each side of the center, so a step is about half of the largest value.
    let half = largest / 2.0;
    let power = 10f64.powf(half.log10().floor());
    [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|digit| digit * power)
        .find(|step| *step >= half)
        .unwrap_or(10.0 * power)
}

/// A number without zeros at its end.
fn short(value: f64) -> String {
    // Adding 0 turns -0 into 0, so that no sign is printed.
    let text = format!("{:.4}", value + 0.0);
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn range_contains_all_used_points() {
        assert_eq!([0.19, 3.9, 4.1, 10.0].map(tick_step), [0.1, 2.0, 5.0, 5.0]);
        assert_eq!([-0.0, 0.5, -2.0].map(short), ["0", "0.5", "-2"]);
        let point = |name: &str, x: f64, is_outlier| ScatterPoint {
            name: name.to_owned(),
            at: [x, 0.0],
            is_outlier,
        };
        let svg = svg(
            ["x, mm", "y, mm"],
            &[point("a", 3.9, false), point("<b>", 90.0, true)],
        );
        assert!(
            svg.contains("cx=\"281.9\"") && svg.contains("cx=\"300.0\""),
            "{svg}"
        );
        assert!(
            svg.contains("&lt;b&gt;: 90.00") && svg.contains("point outlier"),
            "{svg}"
        );
    }
}
