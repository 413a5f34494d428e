//! Checks whether there is a GPU that can train and render.

use crate::recoveries::OpenGpu;
use capture::DeviceInfo;
use capture::doctor::Finding;
use gpu::Gpu;

/// Opens the GPU and describes it, with a remedy for each problem.
#[must_use]
pub fn gpu_findings(open_gpu: OpenGpu) -> Vec<Finding> {
    let gpu = match open_gpu() {
        Ok(gpu) => gpu,
        Err(error) => {
            // The remedy depends on whether there is no adapter at all or a wrong choice.
            let adapters = Gpu::adapters();
            let remedy = if adapters.is_empty() {
                "sudo apt-get install -y libvulkan1 mesa-vulkan-drivers   (a software adapter; a GPU needs its own driver)"
                    .to_owned()
            } else {
                format!(
                    "unset FIELDRIG_GPU, or set it to one of: {}",
                    numbered(&adapters)
                )
            };
            return vec![Finding::fail("gpu", error.to_string(), remedy)];
        }
    };
    // Everything works on a software adapter, so a software adapter is not a failure.
    let adapter = if gpu.is_software() {
        let remedy = "training is slow on a software adapter: install the Vulkan driver of the GPU, if there is one";
        Finding::warn("gpu", gpu.describe(), remedy)
    } else {
        Finding::ok("gpu", gpu.describe())
    };
    let optional = gpu.optional();
    let lanes = optional
        .subgroup_lanes
        .map_or("none".to_owned(), |lanes| lanes.to_string());
    let timestamps = if optional.timestamps {
        "yes"
    } else {
        "no: times per pass are unavailable"
    };
    let mib = gpu.max_binding_bytes() >> 20;
    let message =
        format!("largest buffer {mib} MiB, subgroup lanes {lanes}, timestamps {timestamps}");
    let mut findings = vec![adapter, Finding::ok("gpu limits", message)];
    let adapters = Gpu::adapters();
    // With one adapter there is nothing to select.
    if adapters.len() > 1 {
        findings.push(Finding::ok(
            "gpus",
            format!("{}; FIELDRIG_GPU=N selects one", numbered(&adapters)),
        ));
    }
    findings
}

/// Opens the GPU and describes it as a device.
#[must_use]
pub fn gpu_device(open_gpu: OpenGpu) -> DeviceInfo {
    let (name, usable, note) = match open_gpu() {
        Ok(gpu) if gpu.is_software() => (
            gpu.describe(),
            true,
            "software adapter: works, but slowly".to_owned(),
        ),
        Ok(gpu) => (gpu.describe(), true, "trains and renders".to_owned()),
        Err(error) => ("none".to_owned(), false, error.to_string()),
    };
    DeviceInfo {
        kind: "gpu",
        address: "default".into(),
        name,
        usable,
        note,
    }
}

fn numbered(names: &[String]) -> String {
    let names: Vec<_> = names
        .iter()
        .enumerate()
        .map(|(ix, name)| format!("{ix}: {name}"))
        .collect();
    names.join(", ")
}
