//! Safe calls to the part of librealsense2 that `realsense-rust` lacks. They open sensors
//! individually into one queue, open files as devices, and read names of presets.

#![expect(unsafe_code, reason = "FFI to a C library")]

use super::Problem;
use parking_lot::{Mutex, MutexGuard};
use realsense_rust::device::Device as Info;
use realsense_rust::frame::{DepthFrame, FrameEx, ImageFrame, InfraredFrame};
use realsense_rust::sensor::Sensor as Options;
use realsense_rust::stream_profile::StreamProfile;
use realsense_sys as sys;
use std::ffi::{CStr, CString};
use std::mem::MaybeUninit;
use std::path::Path;
use std::ptr::{NonNull, null_mut};
use std::time::Duration;

/// A frame of any image stream, despite the name of the wrapper type. Its profile contains the
/// actual kind.
pub(super) type Frame = InfraredFrame;

/// Calls the library and converts its error.
pub(super) fn call<T>(
    what: &'static str,
    call: impl FnOnce(*mut *mut sys::rs2_error) -> T,
) -> Result<T, Problem> {
    let mut error = null_mut();
    let result = call(&raw mut error);
    if error.is_null() {
        return Ok(result);
    }
    // SAFETY: the library created the error and it is owned here. Its text lives until it is freed.
    let reason = unsafe {
        let text = CStr::from_ptr(sys::rs2_get_error_message(error))
            .to_string_lossy()
            .into_owned();
        sys::rs2_free_error(error);
        text
    };
    Err(Problem::Library { what, reason })
}

/// Checks a pointer that must not be null after a successful call.
pub(super) fn non_null<T>(what: &'static str, pointer: *mut T) -> Result<NonNull<T>, Problem> {
    NonNull::new(pointer).ok_or_else(|| Problem::Library {
        what,
        reason: "it returned a null pointer".into(),
    })
}

/// Handle of the library that lists connected devices.
#[derive(Debug)]
pub(super) struct Context(NonNull<sys::rs2_context>);

// SAFETY: the library may be called from any thread, and we hold the only pointer.
unsafe impl Send for Context {}

/// A lock that is held while a device is created. The library keeps the relative poses of its
/// streams in one list per process. Two threads that add to this list concurrently write to freed
/// memory (librealsense 2.56.5, `extrinsics_graph::register_extrinsics`).
static DEVICE_CREATION: Mutex<()> = Mutex::new(());

/// Prevents other threads from creating devices at the same time.
pub(super) fn device_creation_lock() -> MutexGuard<'static, ()> {
    DEVICE_CREATION.lock()
}

impl Context {
    pub(super) fn new() -> Result<Self, Problem> {
        const WHAT: &str = "start";
        // The library rejects programs compiled for another minor version, although its interface
        // has only grown. The library's own version is therefore passed. SAFETY: only numbers are
        // passed.
        let context = unsafe {
            let version = call(WHAT, |error| sys::rs2_get_api_version(error))?;
            call(WHAT, |error| sys::rs2_create_context(version, error))?
        };
        Ok(Self(non_null(WHAT, context)?))
    }

    /// All connected cameras.
    pub(super) fn devices(&self) -> Result<Vec<Device>, Problem> {
        const WHAT: &str = "list devices";
        let any = sys::RS2_PRODUCT_LINE_ANY_INTEL.cast_signed();
        let _guard = device_creation_lock();
        // SAFETY: the context is alive. The list is freed below, and devices outlive it.
        unsafe {
            let list = call(WHAT, |error| {
                sys::rs2_query_devices_ex(self.0.as_ptr(), any, error)
            })?;
            let n_devices = call(WHAT, |error| sys::rs2_get_device_count(list, error));
            let device =
                |ix| Device::new(call(WHAT, |error| sys::rs2_create_device(list, ix, error))?);
            // A camera that another program is currently resetting cannot be opened. The other
            // cameras can be opened.
            let devices = n_devices
                .map(|n_devices| (0..n_devices).filter_map(|ix| device(ix).ok()).collect());
            sys::rs2_delete_device_list(list);
            devices
        }
    }

    /// Opens a recorded file as a device that plays back as fast as its images are taken.
    pub(super) fn file(&self, path: &Path) -> Result<Device, Problem> {
        let file_problem = |reason: String| Problem::File {
            path: path.to_owned(),
            reason,
        };
        // The file is opened here first, because the error of the operating system names the cause.
        if let Err(error) = std::fs::File::open(path) {
            return Err(file_problem(error.to_string()));
        }
        let name = path_name(path).map_err(file_problem)?;
        let _guard = device_creation_lock();
        // SAFETY: the context is alive and the name is null-terminated. The device is checked and
        // then owned here.
        let device = unsafe {
            let device = call("open a file", |error| {
                sys::rs2_context_add_device(self.0.as_ptr(), name.as_ptr(), error)
            });
            let device = Device::new(device.map_err(|problem| file_problem(problem.to_string()))?)?;
            call("turn off real-time playback", |error| {
                sys::rs2_playback_device_set_real_time(device.raw.as_ptr(), 0, error);
            })?;
            device
        };
        Ok(device)
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        // SAFETY: created by `new`, and this is the only pointer.
        unsafe { sys::rs2_delete_context(self.0.as_ptr()) }
    }
}

/// File name as a C string.
pub(super) fn path_name(path: &Path) -> Result<CString, String> {
    use std::os::unix::ffi::OsStrExt;
    CString::new(path.as_os_str().as_bytes()).map_err(|error| error.to_string())
}

/// A camera or a file.
#[derive(Debug)]
pub(super) struct Device {
    /// Dropped before the device.
    pub(super) sensors: Vec<Sensor>,
    /// Owns the device.
    pub(super) info: Info,
    raw: NonNull<sys::rs2_device>,
}

// SAFETY: as for `Context`. `Info` is `Send`.
unsafe impl Send for Device {}

impl Device {
    /// # Safety
    /// The pointer must be a device that is not freed elsewhere, or null.
    pub(super) unsafe fn new(device: *mut sys::rs2_device) -> Result<Self, Problem> {
        const WHAT: &str = "list the sensors of a device";
        let raw = non_null("open a device", device)?;
        let info = Info::from(raw);
        // SAFETY: the device lives in `info`. The list is freed below, and sensors outlive it.
        let sensors = unsafe {
            let list = call(WHAT, |error| sys::rs2_query_sensors(raw.as_ptr(), error))?;
            let n_sensors = call(WHAT, |error| sys::rs2_get_sensors_count(list, error));
            let sensor = |ix| {
                Ok(Sensor::new(non_null(
                    WHAT,
                    call(WHAT, |error| sys::rs2_create_sensor(list, ix, error))?,
                )?))
            };
            let sensors = n_sensors.and_then(|n_sensors| (0..n_sensors).map(sensor).collect());
            sys::rs2_delete_sensor_list(list);
            sensors
        };
        Ok(Self {
            sensors: sensors?,
            info,
            raw,
        })
    }

    /// Pointer for other calls, valid while this device is alive.
    #[cfg(feature = "emulation")]
    pub(super) fn as_ptr(&self) -> *mut sys::rs2_device {
        self.raw.as_ptr()
    }

    /// Restarts a camera, which has the effect of reconnecting it.
    pub(super) fn reset(mut self) {
        self.sensors.clear();
        self.info.hardware_reset();
    }

    /// Pauses or resumes the playback of a file.
    pub(super) fn set_paused(&self, is_paused: bool) -> Result<(), Problem> {
        // SAFETY: the device is alive. For a device that is not a file, the call returns an error.
        call("pause or resume a file", |error| unsafe {
            if is_paused {
                sys::rs2_playback_device_pause(self.raw.as_ptr(), error);
            } else {
                sys::rs2_playback_device_resume(self.raw.as_ptr(), error);
            }
        })
    }

    /// Whether the playback of a file has ended or has not started.
    pub(super) fn has_stopped(&self) -> Result<bool, Problem> {
        // SAFETY: the device is alive. For a device that is not a file, the call returns an error.
        let status = call("get the playback status", |error| unsafe {
            sys::rs2_playback_device_get_current_status(self.raw.as_ptr(), error)
        })?;
        Ok(status == sys::rs2_playback_status_RS2_PLAYBACK_STATUS_STOPPED)
    }
}

/// One sensor of a device, with its streams and options.
pub(super) struct Sensor {
    raw: NonNull<sys::rs2_sensor>,
    /// Options of the same sensor. This field does not own the sensor.
    pub(super) options: Options,
}

impl Sensor {
    fn new(raw: NonNull<sys::rs2_sensor>) -> Self {
        Self {
            raw,
            options: Options::from(raw),
        }
    }

    /// All modes of its image streams.
    pub(super) fn modes(&self) -> Result<Modes, Problem> {
        const WHAT: &str = "list the modes of a sensor";
        // SAFETY: the sensor is alive. `Modes` frees the list and keeps it as long as the pointers
        // into it.
        unsafe {
            let list = non_null(
                WHAT,
                call(WHAT, |error| {
                    sys::rs2_get_stream_profiles(self.raw.as_ptr(), error)
                })?,
            )?;
            let mut modes = Modes {
                list,
                modes: Vec::new(),
            };
            let n_modes = call(WHAT, |error| {
                sys::rs2_get_stream_profiles_count(list.as_ptr(), error)
            })?;
            for ix in 0..n_modes {
                let profile = call(WHAT, |error| {
                    sys::rs2_get_stream_profile(list.as_ptr(), ix, error)
                })?;
                modes
                    .modes
                    .extend(Mode::read(non_null(WHAT, profile.cast_mut())?)?);
            }
            Ok(modes)
        }
    }

    /// Opens the given modes.
    pub(super) fn open(&self, modes: &[&Mode]) -> Result<(), Problem> {
        let mut profiles: Vec<*const sys::rs2_stream_profile> = modes
            .iter()
            .map(|mode| mode.profile.as_ptr().cast_const())
            .collect();
        let n_profiles = i32::try_from(profiles.len()).expect("a camera has few streams");
        // SAFETY: sensor and profiles are alive.
        call("open a stream", |error| unsafe {
            sys::rs2_open_multiple(self.raw.as_ptr(), profiles.as_mut_ptr(), n_profiles, error);
        })
    }

    /// Starts the open streams and sends their images to a queue.
    pub(super) fn start(&self, queue: &Queue) -> Result<(), Problem> {
        // SAFETY: both are alive, and the library keeps the queue for as long as the stream runs.
        call("start a stream", |error| unsafe {
            sys::rs2_start_queue(self.raw.as_ptr(), queue.0.as_ptr(), error)
        })
    }

    /// Stops its streams. Does nothing if none is running.
    pub(super) fn stop(&self) {
        // SAFETY: the sensor is alive. Errors only mean that nothing is running, because the camera
        // is disconnected or the file has ended.
        let _ = call("stop a stream", |error| unsafe {
            sys::rs2_stop(self.raw.as_ptr(), error)
        });
        // SAFETY: as above.
        let _ = call("close a stream", |error| unsafe {
            sys::rs2_close(self.raw.as_ptr(), error)
        });
    }

    /// Name that the camera uses for a value of an option.
    pub(super) fn value_name(&self, option: sys::rs2_option, value: f32) -> Option<String> {
        // SAFETY: sensors have options. The text is owned by the library and copied immediately.
        unsafe {
            let text = call("get the name of an option value", |error| {
                sys::rs2_get_option_value_description(
                    self.raw.as_ptr().cast(),
                    option,
                    value,
                    error,
                )
            });
            let text = NonNull::new(text.ok()?.cast_mut())?;
            Some(CStr::from_ptr(text.as_ptr()).to_string_lossy().into_owned())
        }
    }
}

impl std::fmt::Debug for Sensor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Sensor").field(&self.raw).finish()
    }
}

impl Drop for Sensor {
    fn drop(&mut self) {
        // SAFETY: created by `rs2_create_sensor`, and `options` does not free it.
        unsafe { sys::rs2_delete_sensor(self.raw.as_ptr()) }
    }
}

/// The modes of a sensor.
#[derive(Debug)]
pub(super) struct Modes {
    list: NonNull<sys::rs2_stream_profile_list>,
    pub(super) modes: Vec<Mode>,
}

// SAFETY: as for `Context`.
unsafe impl Send for Modes {}

impl Drop for Modes {
    fn drop(&mut self) {
        // SAFETY: created by the library, and this is the only pointer.
        unsafe { sys::rs2_delete_stream_profiles_list(self.list.as_ptr()) }
    }
}

/// One mode of an image stream.
#[derive(Debug)]
pub(super) struct Mode {
    /// Points into the list that contains it.
    profile: NonNull<sys::rs2_stream_profile>,
    pub(super) stream: sys::rs2_stream,
    pub(super) index: i32,
    pub(super) format: sys::rs2_format,
    pub(super) rate_hz: i32,
    pub(super) size_px: [u32; 2],
}

impl Mode {
    /// Returns `None` for streams without images.
    ///
    /// # Safety
    /// The profile must live as long as the mode.
    unsafe fn read(profile: NonNull<sys::rs2_stream_profile>) -> Result<Option<Self>, Problem> {
        const WHAT: &str = "describe a mode";
        let mut stream = 0;
        let mut format = 0;
        let mut index = 0;
        let mut unique = 0;
        let mut rate_hz = 0;
        let mut width = 0;
        let mut height = 0;
        // SAFETY: the profile is alive, and all output pointers are valid.
        unsafe {
            let profile = profile.as_ptr();
            call(WHAT, |error| {
                sys::rs2_get_stream_profile_data(
                    profile,
                    &raw mut stream,
                    &raw mut format,
                    &raw mut index,
                    &raw mut unique,
                    &raw mut rate_hz,
                    error,
                );
            })?;
            if sys::rs2_stream_profile_is(
                profile,
                sys::rs2_extension_RS2_EXTENSION_VIDEO_PROFILE,
                null_mut(),
            ) == 0
            {
                return Ok(None);
            }
            call(WHAT, |error| {
                sys::rs2_get_video_stream_resolution(
                    profile,
                    &raw mut width,
                    &raw mut height,
                    error,
                );
            })?;
        }
        let size_px = [width, height].map(|side| u32::try_from(side).unwrap_or(0));
        Ok(Some(Self {
            profile,
            stream,
            index,
            format,
            rate_hz,
            size_px,
        }))
    }

    /// Intrinsics of this mode.
    pub(super) fn intrinsics(&self) -> Result<sys::rs2_intrinsics, Problem> {
        let mut intrinsics = MaybeUninit::uninit();
        // SAFETY: the profile is alive. On success, all fields were written.
        unsafe {
            call("get intrinsics", |error| {
                sys::rs2_get_video_stream_intrinsics(
                    self.profile.as_ptr(),
                    intrinsics.as_mut_ptr(),
                    error,
                );
            })?;
            Ok(intrinsics.assume_init())
        }
    }

    /// Profile for use with `realsense-rust`. It must not outlive the mode.
    pub(super) fn profile(&self) -> Result<StreamProfile, Problem> {
        let what = "describe a mode";
        StreamProfile::try_from(self.profile).map_err(|error| Problem::Library {
            what,
            reason: error.to_string(),
        })
    }
}

/// Queued images of all streams, in order of arrival. If the queue is full, a file waits, and a
/// camera drops the oldest image.
#[derive(Debug)]
pub(super) struct Queue(NonNull<sys::rs2_frame_queue>);

// SAFETY: as for `Context`.
unsafe impl Send for Queue {}

// SAFETY: the library locks its queues.
unsafe impl Sync for Queue {}

impl Queue {
    pub(super) fn new(capacity: u8) -> Result<Self, Problem> {
        const WHAT: &str = "create a queue";
        // SAFETY: only numbers are passed.
        let queue = call(WHAT, |error| unsafe {
            sys::rs2_create_frame_queue(capacity.into(), error)
        })?;
        Ok(Self(non_null(WHAT, queue)?))
    }

    /// Waits for the next image. Returns `None` if no image arrives in time.
    pub(super) fn wait(&self, timeout: Duration) -> Result<Option<Frame>, Problem> {
        const WHAT: &str = "wait for an image";
        // The library counts whole milliseconds.
        let millis = u32::try_from(timeout.as_millis()).unwrap_or(u32::MAX);
        let mut frame = null_mut();
        // SAFETY: the queue is alive. A received frame is owned here, and `Frame` frees it.
        unsafe {
            let has_arrived = call(WHAT, |error| {
                sys::rs2_try_wait_for_frame(self.0.as_ptr(), millis, &raw mut frame, error)
            })?;
            let Some(frame) = NonNull::new(frame).filter(|_| has_arrived != 0) else {
                return Ok(None);
            };
            match Frame::try_from(frame) {
                Ok(frame) => Ok(Some(frame)),
                Err(error) => {
                    sys::rs2_release_frame(frame.as_ptr());
                    Err(Problem::Library {
                        what: WHAT,
                        reason: error.to_string(),
                    })
                }
            }
        }
    }
}

impl Queue {
    /// Frees all queued images.
    #[cfg(feature = "emulation")]
    pub(super) fn empty(&self) -> Result<(), Problem> {
        loop {
            let mut frame = null_mut();
            // SAFETY: the queue is alive. A received frame is owned here.
            unsafe {
                call("poll for an image", |error| {
                    sys::rs2_poll_for_frame(self.0.as_ptr(), &raw mut frame, error)
                })?;
                if frame.is_null() {
                    return Ok(());
                }
                sys::rs2_release_frame(frame);
            }
        }
    }
}

impl Drop for Queue {
    fn drop(&mut self) {
        // SAFETY: created by `new`, and no stream writes to it any more.
        unsafe { sys::rs2_delete_frame_queue(self.0.as_ptr()) }
    }
}

/// The bytes of a frame.
pub(super) fn bytes<Kind>(frame: &ImageFrame<Kind>) -> &[u8] {
    // SAFETY: the library keeps this many bytes there as long as the frame lives, and nothing
    // writes to them.
    unsafe {
        std::slice::from_raw_parts(
            std::ptr::from_ref(frame.get_data()).cast(),
            frame.get_data_size(),
        )
    }
}

/// Converts a frame to the type that depth filters take.
pub(super) fn as_depth(frame: Frame) -> Result<DepthFrame, Problem> {
    const WHAT: &str = "convert a frame to depth";
    // SAFETY: the new wrapper frees the frame instead of the old one.
    unsafe {
        let raw = frame.get_owned_raw();
        DepthFrame::try_from(raw).map_err(|error| {
            sys::rs2_release_frame(raw.as_ptr());
            Problem::Library {
                what: WHAT,
                reason: error.to_string(),
            }
        })
    }
}
