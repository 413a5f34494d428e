//! GPU time of the kernels of a training step.

use gpu::PassTiming;
use numbers::quantile::median;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};
use trainer::Method;

/// Number of profiled steps, over which medians are taken. It is odd, so that the median is one of
/// the measured values. More steps would take longer. With fewer steps, one slow step could change
/// the median.
const N_PROFILED: usize = 21;
/// Warm-up time, because drivers are slow for a while after large buffers were freed. With a
/// shorter warm-up, these slow steps would be part of the medians.
const PROFILE_WARM_UP: Duration = Duration::from_millis(700);

/// GPU time of each kernel in a step in milliseconds: medians over [`N_PROFILED`] steps, in order
/// of first execution.
pub(super) fn profile(method: &mut dyn Method) -> anyhow::Result<Vec<(&'static str, f64)>> {
    let mut names: Vec<&'static str> = Vec::new();
    let mut by_name: BTreeMap<&'static str, Vec<f64>> = BTreeMap::new();
    let began = Instant::now();
    while began.elapsed() < PROFILE_WARM_UP {
        method.profile_step()?;
    }
    for _ in 0..N_PROFILED {
        let mut sums: BTreeMap<&'static str, f64> = BTreeMap::new();
        // A kernel may run several times in one step, for example in the passes of a sort. Its
        // times are summed before the median is taken.
        for PassTiming { name, millis } in method.profile_step()? {
            *sums.entry(name).or_default() += millis;
            // The map is sorted by name. The list keeps the order of execution.
            if !names.contains(&name) {
                names.push(name);
            }
        }
        sums.into_iter()
            .for_each(|(name, millis)| by_name.entry(name).or_default().push(millis));
    }
    Ok(names
        .into_iter()
        .filter_map(|name| Some((name, median(by_name.get(name)?)?)))
        .collect())
}
