//! LPIPS, the learned perceptual distance, on `SqueezeNet` 1.1 (version 0.1 of the weights).

use super::PixelPair;
use crate::Error;
use candle_core::{Device, Tensor};
use std::collections::HashMap;
use std::path::Path;

/// Minimum side length, pixels. It is the size of the patches to which the weights were fitted.
const MIN_SIDE_PX: u32 = 64;
/// Channel means and standard deviations of the inputs, which are between -1 and 1. They are
/// derived from the usual values of `ImageNet` for inputs between 0 and 1, which are means of
/// 0.485, 0.456, 0.406 and deviations of 0.229, 0.224, 0.225. All values are doubled, and the means
/// are then lowered by 1.
const CHANNEL_MEAN: [f32; 3] = [-0.030, -0.088, -0.188];
const CHANNEL_DEVIATION: [f32; 3] = [0.458, 0.448, 0.450];
/// Keeps the normalization of an all-zero feature finite.
const EPSILON: f64 = 1e-10;
/// Stages of the network. Features are compared after each stage. `true` means that the size is
/// halved before the fire module.
const STAGES: [&[(usize, bool)]; 6] = [
    &[(3, true), (4, false)],
    &[(6, true), (7, false)],
    &[(9, true)],
    &[(10, false)],
    &[(11, false)],
    &[(12, false)],
];

/// The learned perceptual distance of two pictures. It is 0 for equal pictures.
///
/// Features of seven depths of `SqueezeNet` 1.1 are normalized per pixel. Squared differences are
/// weighted per channel, averaged over pixels and summed over depths. Sources: Zhang, Isola, Efros,
/// Shechtman, Wang 2018, section 3, for the distance, and Iandola et al. 2016 for the network.
#[derive(Debug)]
pub struct Lpips {
    first: Convolution,
    stages: Vec<Vec<Fire>>,
    /// Weights of the channels at each depth, `[1, n_channels, 1, 1]`.
    channel_weights: Vec<Tensor>,
}

impl Lpips {
    /// Reads the weights from a safetensors file with `features.*` of `SqueezeNet` 1.1 and
    /// `lin0..6.weight`.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let bytes = files::read(path, files::Budget::PLAIN).map_err(|source| Error::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::from_bytes(&bytes).map_err(|source| Error::LpipsWeights {
            path: path.to_owned(),
            source: source.into(),
        })
    }

    fn from_bytes(bytes: &[u8]) -> candle_core::Result<Self> {
        let tensors = candle_core::safetensors::load_buffer(bytes, &Device::Cpu)?;
        let stages = STAGES
            .iter()
            .map(|fires| {
                fires
                    .iter()
                    .map(|&(ix, halve)| Fire::of(&tensors, ix, halve))
                    .collect()
            })
            .collect::<candle_core::Result<_>>()?;
        let channel_weights = (0..=STAGES.len())
            .map(|depth| {
                tensor_by_name(&tensors, &format!("lin{depth}.weight"))?.reshape((1, (), 1, 1))
            })
            .collect::<candle_core::Result<_>>()?;
        Ok(Self {
            first: Convolution::of(&tensors, "features.0")?,
            stages,
            channel_weights,
        })
    }

    /// The distance between two pictures. Masked pixels are mid-gray in both.
    ///
    /// Fails for pictures with a side below 64 pixels, and if all pixels are masked.
    pub fn distance(&self, pair: &PixelPair<'_>) -> Result<f64, Error> {
        // Smaller pictures would shrink to nothing in the pooling layers, and the weights were not
        // fitted to them.
        pair.require_side("LPIPS", MIN_SIDE_PX)?;
        if !(0..pair.truth_rgba.len() / 4).any(|ix| pair.is_visible(ix)) {
            return Err(Error::AllPixelsMasked);
        }
        self.distance_in_network(pair)
            .map_err(|source| Error::LpipsNetwork(source.into()))
    }

    fn distance_in_network(&self, pair: &PixelPair<'_>) -> candle_core::Result<f64> {
        let mut rendered = self
            .first
            .forward(&network_input(pair, pair.rendered_rgba)?, 0, 2)?;
        let mut truth = self
            .first
            .forward(&network_input(pair, pair.truth_rgba)?, 0, 2)?;
        // Pictures pass through the network side by side, so that only the features of one depth
        // are in memory.
        let mut total = feature_distance(&rendered, &truth, &self.channel_weights[0])?;
        for (stage, weights) in self.stages.iter().zip(&self.channel_weights[1..]) {
            for fire in stage {
                rendered = fire.forward(&rendered)?;
                truth = fire.forward(&truth)?;
            }
            total += feature_distance(&rendered, &truth, weights)?;
        }
        Ok(total)
    }
}

/// `[1, 3, height, width]`. Values are scaled to -1 to 1, and then normalized with the channel
/// means and deviations.
fn network_input(pair: &PixelPair<'_>, rgba: &[u8]) -> candle_core::Result<Tensor> {
    let n_pixels = rgba.len() / 4;
    let mut planes = Vec::with_capacity(3 * n_pixels);
    for color in 0..3 {
        planes.extend((0..n_pixels).map(|ix| {
            // A masked pixel has the same value in both pictures, so it adds no difference itself.
            // It still influences the features of its neighbors.
            let value = if pair.is_visible(ix) {
                f32::from(rgba[4 * ix + color]) / 127.5 - 1.0
            } else {
                0.0
            };
            (value - CHANNEL_MEAN[color]) / CHANNEL_DEVIATION[color]
        }));
    }
    let [width, height] = pair.size_px.map(|side| side as usize);
    Tensor::from_vec(planes, (1, 3, height, width), &Device::Cpu)
}

/// Squared difference of features normalized per pixel, weighted per channel, averaged over pixels.
fn feature_distance(
    rendered: &Tensor,
    truth: &Tensor,
    channel_weights: &Tensor,
) -> candle_core::Result<f64> {
    let difference = (normalized(rendered)? - normalized(truth)?)?;
    let per_pixel = difference
        .sqr()?
        .broadcast_mul(channel_weights)?
        .sum_keepdim(1)?
        .flatten_all()?
        .to_vec1::<f32>()?;
    // The sum is in f64, because a large picture has millions of pixels.
    Ok(per_pixel.iter().copied().map(f64::from).sum::<f64>() / per_pixel.len() as f64)
}

fn normalized(feature: &Tensor) -> candle_core::Result<Tensor> {
    feature.broadcast_div(&(feature.sqr()?.sum_keepdim(1)?.sqrt()? + EPSILON)?)
}

/// A convolution with bias and ReLU.
#[derive(Debug)]
struct Convolution {
    weight: Tensor,
    /// `[1, n_channels, 1, 1]`.
    bias: Tensor,
}

impl Convolution {
    fn of(tensors: &HashMap<String, Tensor>, name: &str) -> candle_core::Result<Self> {
        let weight = tensor_by_name(tensors, &format!("{name}.weight"))?;
        let bias = tensor_by_name(tensors, &format!("{name}.bias"))?.reshape((1, (), 1, 1))?;
        Ok(Self { weight, bias })
    }

    fn forward(
        &self,
        input: &Tensor,
        padding: usize,
        stride: usize,
    ) -> candle_core::Result<Tensor> {
        input
            .conv2d(&self.weight, padding, stride, 1, 1)?
            .broadcast_add(&self.bias)?
            .relu()
    }
}

/// The fire module of `SqueezeNet`. A 1x1 convolution to few channels is followed by 1x1 and 3x3
/// convolutions in parallel.
#[derive(Debug)]
struct Fire {
    halve: bool,
    squeeze: Convolution,
    expand_1x1: Convolution,
    expand_3x3: Convolution,
}

impl Fire {
    fn of(tensors: &HashMap<String, Tensor>, ix: usize, halve: bool) -> candle_core::Result<Self> {
        // Names of the layers in torchvision, from which the weights come.
        let part = |name: &str| Convolution::of(tensors, &format!("features.{ix}.{name}"));
        Ok(Self {
            halve,
            squeeze: part("squeeze")?,
            expand_1x1: part("expand1x1")?,
            expand_3x3: part("expand3x3")?,
        })
    }

    fn forward(&self, input: &Tensor) -> candle_core::Result<Tensor> {
        let input = if self.halve {
            halved(input)?
        } else {
            input.clone()
        };
        let squeezed = self.squeeze.forward(&input, 0, 1)?;
        Tensor::cat(
            &[
                self.expand_1x1.forward(&squeezed, 0, 1)?,
                self.expand_3x3.forward(&squeezed, 1, 1)?,
            ],
            1,
        )
    }
}

/// Max pooling over 3 x 3 windows with a stride of two. For even sizes, the last window reaches
/// past the edge.
///
/// Features are not negative, so the zeros that pad such a window do not change a maximum.
fn halved(feature: &Tensor) -> candle_core::Result<Tensor> {
    let (_, _, height, width) = feature.dims4()?;
    let past_edge = |side: usize| 1 - side % 2;
    let padded = feature
        .pad_with_zeros(2, 0, past_edge(height))?
        .pad_with_zeros(3, 0, past_edge(width))?;
    padded.max_pool2d_with_stride(3, 2)
}

fn tensor_by_name(tensors: &HashMap<String, Tensor>, name: &str) -> candle_core::Result<Tensor> {
    let found = tensors.get(name).cloned();
    found.ok_or_else(|| candle_core::Error::Msg(format!("tensor {name:?} is missing")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pooling_of_even_sides_pads_the_far_edge() {
        let feature = Tensor::arange(0_f32, 16.0, &Device::Cpu)
            .unwrap()
            .reshape((1, 1, 4, 4))
            .unwrap();
        let pooled = halved(&feature)
            .unwrap()
            .flatten_all()
            .unwrap()
            .to_vec1::<f32>()
            .unwrap();
        assert_eq!(pooled, [10.0, 11.0, 14.0, 15.0]);
    }

    #[test]
    fn files_without_weights_are_rejected_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("weights.safetensors");
        assert!(matches!(Lpips::load(&path), Err(Error::Read { .. })));
        std::fs::write(&path, b"not weights").unwrap();
        let error = Lpips::load(&path).unwrap_err();
        assert!(error.to_string().contains("weights.safetensors"), "{error}");
        let empty = HashMap::from([(
            "lin0.weight".to_owned(),
            Tensor::zeros(64, candle_core::DType::F32, &Device::Cpu).unwrap(),
        )]);
        candle_core::safetensors::save(&empty, &path).unwrap();
        assert!(
            Lpips::load(&path)
                .unwrap_err()
                .to_string()
                .contains("features.3.squeeze.weight")
        );
    }
}
