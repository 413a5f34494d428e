//! Emulates a RealSense camera by writing a file. librealsense2 itself records one of its software
//! devices, so the file has the same format as any other recording.

#![expect(unsafe_code, reason = "FFI to a C library")]

mod abi;

use super::sdk::{
    Context, Device, Mode, Modes, Queue, Sensor, call, device_creation_lock, non_null, path_name,
};
use super::{Problem, lens};
use crate::{Image, PixelFormat, YuvLayout};
use abi::{VideoFrame, VideoStream};
use kinematics::{Intrinsics, Transform};
use parking_lot::Mutex;
use realsense_sys as sys;
use std::collections::BTreeMap;
use std::ffi::{CStr, CString, c_void};
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Maximum number of images that the library still has to write. If this number is reached, the
/// writer waits, because the library drops images that it cannot store.
const MAX_QUEUED_IMAGES: usize = 16;
/// If no image is written for this long, the disk is assumed to be full or disconnected.
const MAX_WAIT: Duration = Duration::from_secs(30);
/// Interval of checks for written images.
const POLL: Duration = Duration::from_millis(1);
/// Sensor names of the D400 family. The exposure of the RGB camera is in units of 100 us.
const DEPTH_SENSOR: &CStr = c"Stereo Module";
const IMAGE_SENSOR: &CStr = c"RGB Camera";
const IMAGE_EXPOSURE_SECS: f64 = 100e-6;
const DEPTH_EXPOSURE_SECS: f64 = 1e-6;
const NANOS_PER_MILLI: f64 = 1e6;
const NANOS_PER_MICRO: i64 = 1000;

/// The camera that a file emulates.
#[derive(Clone, Debug)]
pub struct EmulatedCamera {
    /// Model name.
    pub name: String,
    /// Its serial number.
    pub serial: String,
    /// Images per second.
    pub rate_hz: u16,
    /// Lens parameters of the color images.
    pub intrinsics: Intrinsics,
    /// Format of the color images: [`PixelFormat::Rgb8`], `Bgr8`, or `Yuv` with two bytes per
    /// pixel.
    pub format: PixelFormat,
    /// Its depth camera, if any.
    pub depth: Option<EmulatedDepth>,
}

/// Depth camera of an emulated camera.
#[derive(Clone, Debug)]
pub struct EmulatedDepth {
    /// Its lens parameters.
    pub intrinsics: Intrinsics,
    /// Pose of the depth camera in the frame of the color camera.
    pub camera_from_depth: Transform,
    /// Meters per count.
    pub meters_per_count: f64,
}

/// Writes a file. [`BagWriter::finish`] completes it.
#[derive(Debug)]
pub struct BagWriter {
    path: PathBuf,
    /// Number of this file among all files of this process.
    number: u64,
    /// Modes point into the sensors of the recorder.
    _modes: Vec<Modes>,
    recorder: Device,
    queue: Queue,
    color: EmulatedStream,
    depth: Option<EmulatedStream>,
    _device: Device,
    _context: Context,
}

/// One stream of the emulated camera.
#[derive(Debug)]
struct EmulatedStream {
    sensor: NonNull<sys::rs2_sensor>,
    profile: NonNull<sys::rs2_stream_profile>,
    format: PixelFormat,
    bytes_per_pixel: i32,
    size_px: [u32; 2],
    exposure_secs_per_count: f64,
    n_images: i32,
}

// SAFETY: the library may be called from any thread, and the pointers refer to objects owned by
// `BagWriter::_device`.
unsafe impl Send for EmulatedStream {}

impl BagWriter {
    /// Starts a file. An existing file of that name is replaced.
    pub fn create(path: &Path, camera: &EmulatedCamera) -> Result<Self, Problem> {
        let context = Context::new()?;
        // The file usually does not exist. If removing it fails, the library reports an error.
        let _ = std::fs::remove_file(path);
        let _guard = device_creation_lock();
        // SAFETY: the device is checked and then owned here. Sensors and profiles live as long as
        // the device.
        let device = unsafe {
            let device = call("create a software device", |error| {
                abi::rs2_create_software_device(error)
            })?;
            register(device, camera)?;
            device
        };
        // SAFETY: as above. Added sensors live in the device.
        let (color, depth) = unsafe { EmulatedStream::all(device, camera)? };
        // SAFETY: the device is not freed elsewhere.
        let device = unsafe { Device::new(device)? };
        let recorder = recorder(&device, path)?;
        let mut writer = Self {
            path: path.to_owned(),
            number: N_FILES.fetch_add(1, Ordering::Relaxed),
            _modes: Vec::new(),
            recorder,
            queue: Queue::new(u8::try_from(MAX_QUEUED_IMAGES).expect("a small number"))?,
            color,
            depth,
            _device: device,
            _context: context,
        };
        writer.start()?;
        Ok(writer)
    }

    fn start(&mut self) -> Result<(), Problem> {
        for sensor in &self.recorder.sensors {
            self._modes.push(sensor.modes()?);
        }
        for (sensor, modes) in self.recorder.sensors.iter().zip(&self._modes) {
            sensor.open(&modes.modes.iter().collect::<Vec<&Mode>>())?;
        }
        self.recorder
            .sensors
            .iter()
            .try_for_each(|sensor: &Sensor| sensor.start(&self.queue))
    }

    /// Writes one color or depth image. Its stamp is stored as mid-exposure time of the camera
    /// clock, in whole microseconds.
    ///
    /// # Errors
    /// Fails if the format or size of the image differs from the emulated camera, or if the disk
    /// accepts no more data.
    pub fn write(&mut self, image: &Image) -> Result<(), Problem> {
        let file_problem = |reason: String| Problem::File {
            path: self.path.clone(),
            reason,
        };
        let emulated = match (image.is_depth(), &mut self.depth) {
            (true, Some(depth)) => depth,
            (true, None) => return Err(file_problem("the emulated camera has no depth".into())),
            (false, _) => &mut self.color,
        };
        if image.format != emulated.format || image.size_px != emulated.size_px {
            return Err(file_problem(format!(
                "an image is {:?} {:?}, expected {:?} {:?} for the emulated camera",
                image.format, image.size_px, emulated.format, emulated.size_px
            )));
        }
        let bytes = image
            .raw_bytes()
            .map_err(|error| file_problem(error.to_string()))?;
        emulated.send(self.number, image, bytes)?;
        // The recorder also queues recorded images for readers and keeps their memory until the
        // queue is emptied.
        wait_until_written(&self.path, self.number, MAX_QUEUED_IMAGES, || {
            self.queue.empty()
        })
    }

    /// Completes the file and waits until all images are written.
    pub fn finish(self) -> Result<(), Problem> {
        self.queue.empty()?;
        self.recorder.sensors.iter().for_each(Sensor::stop);
        let path = self.path.clone();
        let number = self.number;
        // When the recorder is dropped, the library writes the images that it still holds.
        drop(self);
        wait_until_written(&path, number, 0, || Ok(()))
    }
}

/// A device that records the images of another device in a new file.
fn recorder(device: &Device, path: &Path) -> Result<Device, Problem> {
    let file_problem = |reason: String| Problem::File {
        path: path.to_owned(),
        reason,
    };
    let name = path_name(path).map_err(file_problem)?;
    // SAFETY: device and name are alive. The recorder is then owned here and keeps the device
    // alive.
    unsafe {
        let recorder = call("create a recorder", |error| {
            sys::rs2_create_record_device_ex(device.as_ptr(), name.as_ptr(), 1, error)
        });
        Device::new(recorder.map_err(|problem| file_problem(problem.to_string()))?)
    }
}

/// Registers the identity of the camera with the library.
///
/// # Safety
/// The pointer must be a software device.
unsafe fn register(device: *mut sys::rs2_device, camera: &EmulatedCamera) -> Result<(), Problem> {
    let infos = [
        (
            sys::rs2_camera_info_RS2_CAMERA_INFO_NAME,
            c_string(&camera.name)?,
        ),
        (
            sys::rs2_camera_info_RS2_CAMERA_INFO_SERIAL_NUMBER,
            c_string(&camera.serial)?,
        ),
        (
            sys::rs2_camera_info_RS2_CAMERA_INFO_PRODUCT_LINE,
            c"D400".to_owned(),
        ),
    ];
    for (info, value) in &infos {
        // SAFETY: the caller guarantees that the device is alive, and the text is copied.
        call("set the name of a software device", |error| unsafe {
            abi::rs2_software_device_register_info(device, *info, value.as_ptr(), error);
        })?;
    }
    Ok(())
}

/// A name or serial number as a C string.
fn c_string(text: &str) -> Result<CString, Problem> {
    CString::new(text).map_err(|error| Problem::Library {
        what: "use the name of a camera",
        reason: error.to_string(),
    })
}

impl EmulatedStream {
    /// Adds the color stream and, if the camera has it, the depth stream, with the pose between
    /// them.
    ///
    /// # Safety
    /// The pointer must be a software device that outlives both.
    unsafe fn all(
        device: *mut sys::rs2_device,
        camera: &EmulatedCamera,
    ) -> Result<(Self, Option<Self>), Problem> {
        // SAFETY: guaranteed by the caller. Profiles live as long as the device.
        unsafe {
            let depth = camera
                .depth
                .as_ref()
                .map(|depth| Self::depth(device, camera, depth))
                .transpose()?;
            let color = Self::color(device, camera)?;
            if let (Some(emulated), Some(depth)) = (&depth, &camera.depth) {
                let extrinsics = lens::extrinsics(&depth.camera_from_depth);
                call("register extrinsics", |error| {
                    sys::rs2_register_extrinsics(
                        emulated.profile.as_ptr(),
                        color.profile.as_ptr(),
                        extrinsics,
                        error,
                    );
                })?;
            }
            Ok((color, depth))
        }
    }

    /// # Safety
    /// The pointer must be a software device that outlives this.
    unsafe fn color(
        device: *mut sys::rs2_device,
        camera: &EmulatedCamera,
    ) -> Result<Self, Problem> {
        let format = match camera.format {
            PixelFormat::Rgb8 => Some((sys::rs2_format_RS2_FORMAT_RGB8, 3)),
            PixelFormat::Bgr8 => Some((sys::rs2_format_RS2_FORMAT_BGR8, 3)),
            PixelFormat::Yuv {
                layout: YuvLayout::Yuyv,
                ..
            } => Some((sys::rs2_format_RS2_FORMAT_YUYV, 2)),
            PixelFormat::Yuv {
                layout: YuvLayout::Uyvy,
                ..
            } => Some((sys::rs2_format_RS2_FORMAT_UYVY, 2)),
            _ => None,
        };
        let Some((format, bytes_per_pixel)) = format else {
            let reason = format!("{:?} is not a format of RealSense cameras", camera.format);
            return Err(Problem::Library {
                what: "emulate a camera",
                reason,
            });
        };
        let stream = stream(
            sys::rs2_stream_RS2_STREAM_COLOR,
            1,
            camera.rate_hz,
            &camera.intrinsics,
        );
        let stream = VideoStream {
            bytes_per_pixel,
            format,
            ..stream
        };
        // SAFETY: guaranteed by the caller.
        unsafe {
            Self::add(
                device,
                IMAGE_SENSOR,
                stream,
                camera.format,
                IMAGE_EXPOSURE_SECS,
            )
        }
    }

    /// # Safety
    /// The pointer must be a software device that outlives this.
    unsafe fn depth(
        device: *mut sys::rs2_device,
        camera: &EmulatedCamera,
        depth: &EmulatedDepth,
    ) -> Result<Self, Problem> {
        let stream = stream(
            sys::rs2_stream_RS2_STREAM_DEPTH,
            2,
            camera.rate_hz,
            &depth.intrinsics,
        );
        let stream = VideoStream {
            bytes_per_pixel: 2,
            format: sys::rs2_format_RS2_FORMAT_Z16,
            ..stream
        };
        let format = PixelFormat::DepthU16 {
            meters_per_count: depth.meters_per_count,
        };
        // SAFETY: guaranteed by the caller. The sensor lives in the device.
        unsafe {
            let emulated = Self::add(device, DEPTH_SENSOR, stream, format, DEPTH_EXPOSURE_SECS)?;
            let units = sys::rs2_option_RS2_OPTION_DEPTH_UNITS;
            let scale = narrow(depth.meters_per_count);
            call("set depth units", |error| {
                abi::rs2_software_sensor_add_read_only_option(
                    emulated.sensor.as_ptr(),
                    units,
                    scale,
                    error,
                );
            })?;
            Ok(emulated)
        }
    }

    /// # Safety
    /// The pointer must be a software device that outlives this.
    unsafe fn add(
        device: *mut sys::rs2_device,
        name: &CStr,
        stream: VideoStream,
        format: PixelFormat,
        exposure_secs_per_count: f64,
    ) -> Result<Self, Problem> {
        const WHAT: &str = "create a stream";
        // SAFETY: device and name are alive. Added sensors and streams live in the device.
        unsafe {
            let sensor = call(WHAT, |error| {
                abi::rs2_software_device_add_sensor(device, name.as_ptr(), error)
            })?;
            let sensor = non_null(WHAT, sensor)?;
            let profile = call(WHAT, |error| {
                abi::rs2_software_sensor_add_video_stream_ex(sensor.as_ptr(), stream, 1, error)
            })?;
            let size_px =
                [stream.width, stream.height].map(|side| u32::try_from(side).unwrap_or(0));
            Ok(Self {
                sensor,
                profile: non_null(WHAT, profile)?,
                format,
                bytes_per_pixel: stream.bytes_per_pixel,
                size_px,
                exposure_secs_per_count,
                n_images: 0,
            })
        }
    }

    /// Passes an image to the emulated camera.
    fn send(&mut self, file: u64, image: &Image, bytes: &[u8]) -> Result<(), Problem> {
        self.n_images += 1;
        let micros = image.stamp.0.div_euclid(NANOS_PER_MICRO);
        self.set_metadata(
            sys::rs2_frame_metadata_value_RS2_FRAME_METADATA_SENSOR_TIMESTAMP,
            micros,
        )?;
        self.set_metadata(
            sys::rs2_frame_metadata_value_RS2_FRAME_METADATA_FRAME_COUNTER,
            self.n_images.into(),
        )?;
        // Without a rate, the library derives one from two stamps, which may divide by zero.
        self.set_metadata(
            sys::rs2_frame_metadata_value_RS2_FRAME_METADATA_ACTUAL_FPS,
            0,
        )?;
        if let Some(secs) = image.exposure_secs {
            #[expect(
                clippy::cast_possible_truncation,
                reason = "the cast saturates as intended"
            )]
            let counts = (secs / self.exposure_secs_per_count).round() as i64;
            self.set_metadata(
                sys::rs2_frame_metadata_value_RS2_FRAME_METADATA_ACTUAL_EXPOSURE,
                counts,
            )?;
        }
        let frame = VideoFrame {
            pixels: lend_pixels(file, bytes),
            deleter: reclaim_pixels,
            bytes_per_line: i32::try_from(self.size_px[0]).unwrap_or(0) * self.bytes_per_pixel,
            bytes_per_pixel: self.bytes_per_pixel,
            millis: image.stamp.0 as f64 / NANOS_PER_MILLI,
            domain: sys::rs2_timestamp_domain_RS2_TIMESTAMP_DOMAIN_HARDWARE_CLOCK,
            number: self.n_images,
            profile: self.profile.as_ptr(),
            meters_per_count: match self.format {
                PixelFormat::DepthU16 { meters_per_count } => narrow(meters_per_count),
                _ => 0.0,
            },
        };
        // SAFETY: the sensor lives in the device. The pixels live until the library returns them to
        // `reclaim_pixels`.
        call("write an image", |error| unsafe {
            abi::rs2_software_sensor_on_video_frame(self.sensor.as_ptr(), frame, error);
        })
    }

    fn set_metadata(&self, key: sys::rs2_frame_metadata_value, value: i64) -> Result<(), Problem> {
        // SAFETY: the sensor lives in the device.
        call("write metadata", |error| unsafe {
            abi::rs2_software_sensor_set_metadata(self.sensor.as_ptr(), key, value, error);
        })
    }
}

/// Properties common to all streams. The caller sets format and bytes per pixel.
fn stream(
    stream: sys::rs2_stream,
    unique_id: i32,
    rate_hz: u16,
    intrinsics: &Intrinsics,
) -> VideoStream {
    let intrinsics = lens::raw(intrinsics);
    VideoStream {
        stream,
        index: 0,
        unique_id,
        width: intrinsics.width,
        height: intrinsics.height,
        rate_hz: rate_hz.into(),
        bytes_per_pixel: 0,
        format: sys::rs2_format_RS2_FORMAT_ANY,
        intrinsics,
    }
}

/// Images by address, each with the number of its file.
type LentPixels = BTreeMap<usize, (u64, Box<[u8]>)>;

/// Images that the library currently uses. The library returns only the addresses of images.
static LENT_PIXELS: Mutex<LentPixels> = Mutex::new(BTreeMap::new());
/// Number of files started so far.
static N_FILES: AtomicU64 = AtomicU64::new(0);

fn lend_pixels(file: u64, bytes: &[u8]) -> *mut c_void {
    // The library returns the pixels on a thread of its own when it has written them, so they
    // cannot be borrowed.
    let mut copy: Box<[u8]> = bytes.into();
    let pixels = copy.as_mut_ptr();
    LENT_PIXELS.lock().insert(pixels.addr(), (file, copy));
    pixels.cast()
}

extern "C" fn reclaim_pixels(pixels: *mut c_void) {
    LENT_PIXELS.lock().remove(&pixels.addr());
}

/// Waits until the library holds at most this many images of a file.
fn wait_until_written(
    path: &Path,
    file: u64,
    max_pending: usize,
    poll: impl Fn() -> Result<(), Problem>,
) -> Result<(), Problem> {
    let started = Instant::now();
    loop {
        // Every round polls, because this frees images that have been written in the meantime.
        poll()?;
        if LENT_PIXELS
            .lock()
            .values()
            .filter(|(owner, _)| *owner == file)
            .count()
            <= max_pending
        {
            return Ok(());
        }
        if started.elapsed() > MAX_WAIT {
            return Err(Problem::File {
                path: path.to_owned(),
                reason: format!("no image was written for {MAX_WAIT:?}"),
            });
        }
        std::thread::sleep(POLL);
    }
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "the library uses single precision"
)]
fn narrow(number: f64) -> f32 {
    number as f32
}
