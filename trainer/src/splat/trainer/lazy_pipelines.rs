//! Training pipelines. They are compiled on another thread or on demand, because compilation takes
//! seconds.

use crate::Error;
use crate::splat::kernels::TrainPipelines;
use background::Task;
use gpu::Gpu;
use std::sync::Arc;

/// Compilation state of the training pipelines.
#[derive(Debug)]
pub(super) enum LazyPipelines {
    /// To be compiled on first use.
    OnDemand,
    Compiling(Compiling),
    Ready(Arc<TrainPipelines>),
    Failed,
}

/// A thread that compiles the pipelines. Drop waits for the thread, because NVIDIA's driver
/// corrupts the heap if the process exits during compilation.
#[derive(Debug)]
pub(super) struct Compiling(Option<Task<Result<Box<TrainPipelines>, Error>>>);

impl Compiling {
    fn finish(&mut self, gpu: &Gpu) -> Result<Box<TrainPipelines>, Error> {
        let finished = self.0.take().map(Task::join);
        let Some(Ok(compiled)) = finished else {
            return Err(gpu
                .failure_or("the thread that compiles the pipelines panicked")
                .into());
        };
        compiled
    }
}

impl Drop for Compiling {
    fn drop(&mut self) {
        if let Some(thread) = self.0.take() {
            let _ = thread.join();
        }
    }
}

impl LazyPipelines {
    /// Starts compiling on another thread.
    pub(super) fn start(gpu: &Arc<Gpu>) -> Self {
        let gpu = gpu.clone();
        Self::Compiling(Compiling(Some(Task::start("pipelines", move || {
            TrainPipelines::new(&gpu).map(Box::new)
        }))))
    }

    /// Waits for the pipelines, or compiles them on first use.
    pub(super) fn wait(&mut self, gpu: &Gpu) -> Result<Arc<TrainPipelines>, Error> {
        if let Self::Ready(ready) = self {
            return Ok(ready.clone());
        }
        // If an error is returned below, the state remains `Failed`, because a second attempt would
        // take seconds and fail again.
        let ready = Arc::new(match std::mem::replace(self, Self::Failed) {
            Self::Compiling(mut thread) => *thread.finish(gpu)?,
            Self::OnDemand => TrainPipelines::new(gpu)?,
            Self::Ready(_) | Self::Failed => {
                return Err(gpu
                    .failure_or("a step was requested although its pipelines could not be compiled")
                    .into());
            }
        });
        *self = Self::Ready(ready.clone());
        Ok(ready)
    }

    /// The pipelines, if an earlier [`Self::wait`] has returned them.
    pub(super) fn ready(&self) -> Option<Arc<TrainPipelines>> {
        match self {
            Self::Ready(ready) => Some(ready.clone()),
            Self::OnDemand | Self::Compiling(_) | Self::Failed => None,
        }
    }
}
