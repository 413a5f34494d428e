//! Initial time offset by correlation of rotation rates.
//!
//! The magnitude of the rotation rate of rigidly joined bodies is the same in every frame (Furrer
//! et al. 2017, "Evaluation of combined time-offset estimation and hand-eye calibration on robotic
//! datasets").

use super::stamps;
use super::stream::Stream;
use crate::hand_eye::Refusal;

/// Correlation below this value does not show a common motion. Unrelated streams of a few seconds
/// reach it by chance, but their orientations do not agree in the refinement.
const MIN_CORRELATION: f64 = 0.3;

/// The initial offset, accurate to about a step of the grid.
#[derive(Clone, Copy, Debug)]
pub(super) struct Coarse {
    pub(super) offset_secs: f64,
    pub(super) step_secs: f64,
}

/// The offset with the most significant correlation, followed by other maxima.
///
/// # Errors
/// Fails if the streams have no rotation, or no significant correlation.
pub(super) fn correlate(
    a: &Stream,
    b: &Stream,
    max_offset_secs: Option<f64>,
) -> Result<Vec<Coarse>, Refusal> {
    /// Lower maxima are not tried.
    const SIMILAR: f64 = 0.7;
    /// Periodic motions have one maximum per period. The number of maxima is limited, because each
    /// of them is refined, which takes most of the time.
    const MAX_OTHERS: usize = 4;
    // Stamps in other units spread the motion over a long time, which looks like no rotation. This
    // is tested per stream, because streams in different units do not overlap.
    for (name, stream) in [("A", a), ("B", b)] {
        let own = Grid::new(stream, stream);
        if let (Some(refusal), Err(_)) = (
            stamps::unit_mistake(name, stream.median_step_secs()),
            own.rates[0].check_excitation(name),
        ) {
            return Err(refusal);
        }
    }
    let grid = Grid::new(a, b);
    for (name, rates) in [("A", &grid.rates[0]), ("B", &grid.rates[1])] {
        rates.check_excitation(name)?;
    }
    let correlations = grid.correlations(max_offset_secs);
    let Some(best) = correlations
        .iter()
        .max_by(|p, q| p.significance.total_cmp(&q.significance))
    else {
        let most = max_offset_secs.unwrap_or(f64::INFINITY);
        let nearest = grid
            .correlations(None)
            .iter()
            .map(|at| grid.offset_secs(at.lag))
            .min_by(|p, q| p.abs().total_cmp(&q.abs()));
        return Err(match nearest {
            Some(nearest) => Refusal::new(
                format!(
                    "at offsets of at most {most} s, the streams do not overlap long enough; the smallest offset at which they do is {nearest:.3} s"
                ),
                "search larger offsets, or check the stamps",
            ),
            None => Refusal::new(
                "the streams do not overlap long enough",
                "record both streams at the same time",
            ),
        });
    };
    // There is no correlation. One possible cause is a wrong rate of one clock, which has its own
    // remedy.
    if best.value < MIN_CORRELATION {
        if let Some(refusal) = clock_rate_mistake(a, b) {
            return Err(refusal);
        }
        return Err(Refusal::new(
            format!(
                "the rotation rates of the streams are not correlated (at most {:.2}; at least {MIN_CORRELATION} is needed)",
                best.value
            ),
            "check that both bodies are rigidly joined and recorded at the same time, and rotate them irregularly",
        ));
    }
    let others = other_maxima(&correlations, best);
    let lags = [best]
        .into_iter()
        .chain(
            others
                .into_iter()
                .filter(|other| other.value > SIMILAR * best.value)
                .take(MAX_OTHERS),
        )
        .map(|correlation| correlation.lag);
    Ok(lags
        .map(|lag| Coarse {
            offset_secs: grid.offset_secs(lag),
            step_secs: grid.step_secs,
        })
        .collect())
}

/// Explains the missing correlation by stamps that advance too fast or too slowly by a factor of
/// two.
pub(super) fn clock_rate_mistake(a: &Stream, b: &Stream) -> Option<Refusal> {
    /// For unrelated motions of usual length, the correlation is below this value.
    const MIN_CORRELATION: f64 = 0.7;
    let words = [(0.5, "twice"), (2.0, "half")]
        .into_iter()
        .find(|(factor, _)| largest_correlation(a, &b.scaled(*factor)) > MIN_CORRELATION)?
        .1;
    Some(Refusal::new(
        format!(
            "the stamps of stream B advance {words} as fast as those of stream A: only then do the motions agree"
        ),
        "check how the stamps were computed, for example from a frame number and a wrong frame rate",
    ))
}

/// Largest correlation of two streams at any offset.
fn largest_correlation(a: &Stream, b: &Stream) -> f64 {
    Grid::new(a, b)
        .correlations(None)
        .iter()
        .map(|correlation| correlation.value)
        .fold(0.0, f64::max)
}

fn signed(n: usize) -> i64 {
    i64::try_from(n).unwrap_or(i64::MAX / 2)
}

/// Rotation rates of both streams at the same intervals.
pub(super) struct Grid {
    pub(super) rates: [Rates; 2],
    pub(super) step_secs: f64,
    /// Offset without a lag.
    base_secs: f64,
}

impl Grid {
    pub(super) fn new(a: &Stream, b: &Stream) -> Self {
        // The time grows with the square of the number of points. In recordings that need more
        // points, the step is longer, and the refinement starts from a less accurate offset.
        const MAX_POINTS: f64 = 4000.0;
        let durations = [a, b].map(|stream| stream.end_secs() - stream.start_secs());
        let finest = a.step_secs().max(b.step_secs());
        let step_secs = finest.max(durations[0].max(durations[1]) / MAX_POINTS);
        // The windows are two steps long. Shorter windows amplify noise, and longer windows blur
        // the motion.
        let rates = [a, b].map(|stream| Rates::new(stream, step_secs, 2.0 * step_secs));
        Self {
            rates,
            step_secs,
            base_secs: a.start_secs() - b.start_secs(),
        }
    }

    /// Correlations at all lags with enough overlap. Without a limit, clocks with different zeros
    /// are allowed.
    pub(super) fn correlations(&self, max_offset_secs: Option<f64>) -> Vec<Correlation> {
        // Minimum overlap as a fraction of the shorter stream. With less overlap, correlations are
        // often high by chance.
        const MIN_OVERLAP: f64 = 0.25;
        let [n_a, n_b] = self
            .rates
            .each_ref()
            .map(|rates| signed(rates.values.len()));
        let min_overlap = (MIN_OVERLAP * n_a.min(n_b) as f64).max(10.0);
        (-n_b..=n_a)
            .filter(|lag| {
                max_offset_secs
                    .is_none_or(|most| self.offset_secs(*lag).abs() <= most.max(self.step_secs))
            })
            .filter_map(|lag| Correlation::new(&self.rates[0], &self.rates[1], lag, min_overlap))
            .collect()
    }

    pub(super) fn offset_secs(&self, lag: i64) -> f64 {
        self.base_secs + lag as f64 * self.step_secs
    }
}

/// Rotation rates on a regular grid. They are `None` in gaps.
pub(super) struct Rates {
    pub(super) values: Vec<Option<f64>>,
}

impl Rates {
    fn new(stream: &Stream, step_secs: f64, window_secs: f64) -> Self {
        let duration = stream.end_secs() - stream.start_secs();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a few thousand"
        )]
        let n = (duration / step_secs) as usize + 1;
        let at = |ix: usize| {
            stream.rotation_rate(stream.start_secs() + ix as f64 * step_secs, window_secs)
        };
        let mut values: Vec<Option<f64>> = (0..n).map(at).collect();
        // A single wrong pose gives a rate that would dominate the correlation.
        let mut sorted: Vec<f64> = values.iter().flatten().copied().collect();
        if let Some(limit) =
            numbers::quantile::quantile(&mut sorted, 0.95, numbers::quantile::Rank::Nearest)
        {
            values
                .iter_mut()
                .flatten()
                .for_each(|rate| *rate = rate.min(limit));
        }
        Self { values }
    }

    /// # Errors
    /// Fails if the rate hardly changes.
    fn check_excitation(&self, name: &str) -> Result<(), Refusal> {
        /// Minimum standard deviation of the rotation rates. Below this limit, tracking noise
        /// dominates. The limit is a tenth of the value for a hand-held or slowly moving camera.
        const MIN_DEVIATION_RAD_S: f64 = 0.02;
        let rates: Vec<f64> = self.values.iter().flatten().copied().collect();
        let n = rates.len().max(1) as f64;
        let mean = rates.iter().sum::<f64>() / n;
        let deviation = (rates.iter().map(|rate| (rate - mean).powi(2)).sum::<f64>() / n).sqrt();
        if deviation >= MIN_DEVIATION_RAD_S {
            return Ok(());
        }
        let what = if mean < MIN_DEVIATION_RAD_S {
            "hardly rotates"
        } else {
            "rotates at a constant rate"
        };
        Err(Refusal::new(
            format!(
                "body {name} {what} ({:.2} degrees/s, deviation {:.2}; a deviation of at least {:.1} is needed): the motion does not depend on the time offset",
                mean.to_degrees(),
                deviation.to_degrees(),
                MIN_DEVIATION_RAD_S.to_degrees()
            ),
            "rotate the bodies back and forth, with pauses and changes of speed",
        ))
    }
}

/// Correlation at one lag.
pub(super) struct Correlation {
    pub(super) lag: i64,
    pub(super) value: f64,
    /// Value of the t statistic, which gives long overlaps more weight.
    significance: f64,
}

impl Correlation {
    /// Correlation of `a[ix]` with `b[ix - lag]`. `None` if the overlap is too short.
    fn new(a: &Rates, b: &Rates, lag: i64, min_overlap: f64) -> Option<Self> {
        let first = usize::try_from(lag.max(0)).ok()?;
        let first_b = usize::try_from((-lag).max(0)).ok()?;
        let a = a.values.get(first..)?;
        let b = b.values.get(first_b..)?;
        let mut n = 0.0;
        let mut sums = [0.0; 2];
        let mut squares = [0.0; 2];
        let mut product = 0.0;
        for (x, y) in a.iter().zip(b).filter_map(|(a, b)| Some(((*a)?, (*b)?))) {
            n += 1.0;
            sums[0] += x;
            sums[1] += y;
            squares[0] += x * x;
            squares[1] += y * y;
            product += x * y;
        }
        (n >= min_overlap).then_some(())?;
        let variance = |ix: usize| squares[ix] / n - (sums[ix] / n).powi(2);
        let value =
            (product / n - sums[0] * sums[1] / (n * n)) / (variance(0) * variance(1)).sqrt();
        // A constant rate has no variance.
        value.is_finite().then_some(())?;
        let significance = value * (n / (1.0 - value * value).max(1e-9)).sqrt();
        Some(Self {
            lag,
            value,
            significance,
        })
    }
}

/// Whether a correlation is larger than both neighbors. If correlations are equal, the last
/// correlation counts as larger.
fn is_maximum(correlations: &[Correlation], ix: usize) -> bool {
    let value = correlations[ix].value;
    ix > 0
        && ix + 1 < correlations.len()
        && value >= correlations[ix - 1].value
        && value > correlations[ix + 1].value
}

/// Maxima outside the neighborhood of the best maximum, the most significant first.
fn other_maxima<'a>(correlations: &'a [Correlation], best: &Correlation) -> Vec<&'a Correlation> {
    // The neighborhood of the maximum ends where the correlation falls to half.
    let best_ix = correlations
        .iter()
        .position(|correlation| correlation.lag == best.lag)
        .unwrap_or(0);
    let is_high = |correlation: &Correlation| correlation.value > 0.5 * best.value;
    let n_after = correlations[best_ix..]
        .iter()
        .take_while(|correlation| is_high(correlation))
        .count();
    let n_before = correlations[..best_ix]
        .iter()
        .rev()
        .take_while(|correlation| is_high(correlation))
        .count();
    let mut others: Vec<&Correlation> = (0..correlations.len())
        .filter(|ix| ix + n_before < best_ix || *ix >= best_ix + n_after)
        .filter(|ix| is_maximum(correlations, *ix))
        .map(|ix| &correlations[ix])
        .collect();
    others.sort_by(|p, q| q.significance.total_cmp(&p.significance));
    others
}
