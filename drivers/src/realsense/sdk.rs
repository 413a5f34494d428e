//! The part of librealsense2 that `realsense-rust` leaves out, as safe calls: sensors opened one by one into one queue, files as
//! devices, and the names of presets.

#![expect(unsafe_code, reason = "the border to a C library")]

use super::Problem;
use realsense_rust::device::Device as Info;
use realsense_rust::frame::{DepthFrame, FrameEx, ImageFrame, InfraredFrame};
use realsense_rust::sensor::Sensor as Options;
use realsense_rust::stream_profile::StreamProfile;
use realsense_sys as sys;
use std::ffi::{CStr, CString};
use std::mem::MaybeUninit;
use std::path::Path;
use std::ptr::{NonNull, null_mut};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// A frame of any kind of image, whatever the wrapper's type is called; which, its profile says.
pub(super) type Frame = InfraredFrame;

/// Calls the library with room for its error, and tells that.
pub(super) fn call<T>(what: &'static str, call: impl FnOnce(*mut *mut sys::rs2_error) -> T) -> Result<T, Problem> {
    let mut error = null_mut();
    let result = call(&raw mut error);
    if error.is_null() {
        return Ok(result);
    }
    // SAFETY: the library has made the error and it is ours; its text lives until it is freed.
    let reason = unsafe {
        let text = CStr::from_ptr(sys::rs2_get_error_message(error)).to_string_lossy().into_owned();
        sys::rs2_free_error(error);
        text
    };
    Err(Problem::Library { what, reason })
}

/// What must not be null after a call without an error.
pub(super) fn non_null<T>(what: &'static str, pointer: *mut T) -> Result<NonNull<T>, Problem> {
    NonNull::new(pointer).ok_or_else(|| Problem::Library { what, reason: "it gave nothing".into() })
}

/// The library's view of what is plugged in.
#[derive(Debug)]
pub(super) struct Context(NonNull<sys::rs2_context>);

// SAFETY: the library may be called from any thread, and we hold the only pointer.
unsafe impl Send for Context {}

/// Held while a device is made. The library notes in one list of the process how its streams lie to each other, and two threads that
/// add to it at once write into freed memory (librealsense 2.56.5, `extrinsics_graph::register_extrinsics`).
static DEVICE_CREATION: Mutex<()> = Mutex::new(());

/// Keeps other threads from making devices meanwhile.
pub(super) fn device_creation_lock() -> MutexGuard<'static, ()> {
    // There is nothing behind it that a thread that panicked could have left half done.
    DEVICE_CREATION.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Context {
    pub(super) fn new() -> Result<Self, Problem> {
        const WHAT: &str = "start";
        // The library refuses programs made for another minor version, though its interface has only grown: so it is told its own.
        // SAFETY: only numbers go in.
        let context = unsafe {
            let version = call(WHAT, |error| sys::rs2_get_api_version(error))?;
            call(WHAT, |error| sys::rs2_create_context(version, error))?
        };
        Ok(Self(non_null(WHAT, context)?))
    }

    /// All cameras that are plugged in.
    pub(super) fn devices(&self) -> Result<Vec<Device>, Problem> {
        const WHAT: &str = "list devices";
        let any = sys::RS2_PRODUCT_LINE_ANY_INTEL.cast_signed();
        let _guard = device_creation_lock();
        // SAFETY: the context lives; the list is freed below, and devices outlive it.
        unsafe {
            let list = call(WHAT, |error| sys::rs2_query_devices_ex(self.0.as_ptr(), any, error))?;
            let n_devices = call(WHAT, |error| sys::rs2_get_device_count(list, error));
            let device = |ix| Device::new(call(WHAT, |error| sys::rs2_create_device(list, ix, error))?);
            // One that another program is just resetting cannot be opened; the others can.
            let devices = n_devices.map(|n_devices| (0..n_devices).filter_map(|ix| device(ix).ok()).collect());
            sys::rs2_delete_device_list(list);
            devices
        }
    }

    /// A recorded file as a device that plays as fast as its images are taken.
    pub(super) fn file(&self, path: &Path) -> Result<Device, Problem> {
        let file_problem = |reason: String| Problem::File { path: path.to_owned(), reason };
        if let Err(error) = std::fs::File::open(path) {
            return Err(file_problem(error.to_string()));
        }
        let name = path_name(path).map_err(file_problem)?;
        let _guard = device_creation_lock();
        // SAFETY: the context lives, the name ends with a zero; the device is checked and then ours.
        let device = unsafe {
            let device =
                call("play a file", |error| sys::rs2_context_add_device(self.0.as_ptr(), name.as_ptr(), error));
            let device = Device::new(device.map_err(|problem| file_problem(problem.to_string()))?)?;
            call("play as fast as it is read", |error| {
                sys::rs2_playback_device_set_real_time(device.raw.as_ptr(), 0, error);
            })?;
            device
        };
        Ok(device)
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        // SAFETY: made by `new`, and nobody else has it.
        unsafe { sys::rs2_delete_context(self.0.as_ptr()) }
    }
}

/// The name of a file as C has it.
pub(super) fn path_name(path: &Path) -> Result<CString, String> {
    use std::os::unix::ffi::OsStrExt;
    CString::new(path.as_os_str().as_bytes()).map_err(|error| error.to_string())
}

/// A camera or a file.
#[derive(Debug)]
pub(super) struct Device {
    /// Its sensors go before it.
    pub(super) sensors: Vec<Sensor>,
    /// Owns the device.
    pub(super) info: Info,
    raw: NonNull<sys::rs2_device>,
}

// SAFETY: as for `Context`; `Info` is `Send`.
unsafe impl Send for Device {}

impl Device {
    /// # Safety
    /// The pointer must be a device that nobody else frees, or null.
    pub(super) unsafe fn new(device: *mut sys::rs2_device) -> Result<Self, Problem> {
        const WHAT: &str = "list the sensors of a device";
        let raw = non_null("open a device", device)?;
        let info = Info::from(raw);
        // SAFETY: the device lives in `info`; the list is freed below, and sensors outlive it.
        let sensors = unsafe {
            let list = call(WHAT, |error| sys::rs2_query_sensors(raw.as_ptr(), error))?;
            let n_sensors = call(WHAT, |error| sys::rs2_get_sensors_count(list, error));
            let sensor =
                |ix| Ok(Sensor::new(non_null(WHAT, call(WHAT, |error| sys::rs2_create_sensor(list, ix, error))?)?));
            let sensors = n_sensors.and_then(|n_sensors| (0..n_sensors).map(sensor).collect());
            sys::rs2_delete_sensor_list(list);
            sensors
        };
        Ok(Self { sensors: sensors?, info, raw })
    }

    /// For calls that only this device is needed for, while it lives.
    pub(super) fn as_ptr(&self) -> *mut sys::rs2_device {
        self.raw.as_ptr()
    }

    /// Makes a camera start anew, as if it were unplugged and plugged in.
    pub(super) fn reset(mut self) {
        self.sensors.clear();
        self.info.hardware_reset();
    }

    /// Holds a file back, or lets it go on.
    pub(super) fn set_paused(&self, is_paused: bool) -> Result<(), Problem> {
        // SAFETY: the device lives; for one that is no file it is an error.
        call("hold a file", |error| unsafe {
            match is_paused {
                true => sys::rs2_playback_device_pause(self.raw.as_ptr(), error),
                false => sys::rs2_playback_device_resume(self.raw.as_ptr(), error),
            }
        })
    }

    /// Whether a file has been played to its end, or not begun.
    pub(super) fn has_stopped(&self) -> Result<bool, Problem> {
        // SAFETY: the device lives; for one that is no file it is an error.
        let status = call("tell how far it is", |error| unsafe {
            sys::rs2_playback_device_get_current_status(self.raw.as_ptr(), error)
        })?;
        Ok(status == sys::rs2_playback_status_RS2_PLAYBACK_STATUS_STOPPED)
    }
}

/// One sensor of a device: it has streams and options.
pub(super) struct Sensor {
    raw: NonNull<sys::rs2_sensor>,
    /// The same sensor, which it does not own.
    pub(super) options: Options,
}

impl Sensor {
    fn new(raw: NonNull<sys::rs2_sensor>) -> Self {
        Self { raw, options: Options::from(raw) }
    }

    /// All modes of its image streams.
    pub(super) fn modes(&self) -> Result<Modes, Problem> {
        const WHAT: &str = "list the modes of a sensor";
        // SAFETY: the sensor lives; `Modes` frees the list and keeps it as long as pointers into it.
        unsafe {
            let list = non_null(WHAT, call(WHAT, |error| sys::rs2_get_stream_profiles(self.raw.as_ptr(), error))?)?;
            let mut modes = Modes { list, modes: Vec::new() };
            let n_modes = call(WHAT, |error| sys::rs2_get_stream_profiles_count(list.as_ptr(), error))?;
            for ix in 0..n_modes {
                let profile = call(WHAT, |error| sys::rs2_get_stream_profile(list.as_ptr(), ix, error))?;
                modes.modes.extend(Mode::read(non_null(WHAT, profile.cast_mut())?)?);
            }
            Ok(modes)
        }
    }

    /// Opens some of its modes.
    pub(super) fn open(&self, modes: &[&Mode]) -> Result<(), Problem> {
        let mut profiles: Vec<*const sys::rs2_stream_profile> =
            modes.iter().map(|mode| mode.profile.as_ptr().cast_const()).collect();
        let n_profiles = i32::try_from(profiles.len()).expect("a camera has few streams");
        // SAFETY: sensor and profiles live.
        call("open a stream", |error| unsafe {
            sys::rs2_open_multiple(self.raw.as_ptr(), profiles.as_mut_ptr(), n_profiles, error);
        })
    }

    /// Lets the images of what is open run into a queue.
    pub(super) fn start(&self, queue: &Queue) -> Result<(), Problem> {
        // SAFETY: both live, and the library itself keeps the queue for as long as the stream runs.
        call("start a stream", |error| unsafe { sys::rs2_start_queue(self.raw.as_ptr(), queue.0.as_ptr(), error) })
    }

    /// Ends its streams; one that does not run is left alone.
    pub(super) fn stop(&self) {
        // SAFETY: the sensor lives. A camera that is gone, or a file at its end, says that nothing runs: that is what is wanted.
        let _ = call("stop a stream", |error| unsafe { sys::rs2_stop(self.raw.as_ptr(), error) });
        // SAFETY: as above.
        let _ = call("close a stream", |error| unsafe { sys::rs2_close(self.raw.as_ptr(), error) });
    }

    /// What the camera calls a value of an option.
    pub(super) fn value_name(&self, option: sys::rs2_option, value: f32) -> Option<String> {
        // SAFETY: a sensor has options; the text is the library's own and is copied at once.
        unsafe {
            let text = call("name a value", |error| {
                sys::rs2_get_option_value_description(self.raw.as_ptr().cast(), option, value, error)
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
        // SAFETY: made by `rs2_create_sensor`, and `options` does not free it.
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
        // SAFETY: made by the library, and nobody else has it.
        unsafe { sys::rs2_delete_stream_profiles_list(self.list.as_ptr()) }
    }
}

/// One mode of an image stream.
#[derive(Debug)]
pub(super) struct Mode {
    /// Points into the list that it came in.
    profile: NonNull<sys::rs2_stream_profile>,
    pub(super) stream: sys::rs2_stream,
    pub(super) index: i32,
    pub(super) format: sys::rs2_format,
    pub(super) rate_hz: i32,
    pub(super) size_px: [u32; 2],
}

impl Mode {
    /// None for streams that give no images.
    ///
    /// # Safety
    /// The profile must live as long as the mode.
    unsafe fn read(profile: NonNull<sys::rs2_stream_profile>) -> Result<Option<Self>, Problem> {
        const WHAT: &str = "describe a mode";
        let (mut stream, mut format) = (0, 0);
        let (mut index, mut unique, mut rate_hz, mut width, mut height) = (0, 0, 0, 0, 0);
        // SAFETY: the profile lives, and all places are there to be written.
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
            if sys::rs2_stream_profile_is(profile, sys::rs2_extension_RS2_EXTENSION_VIDEO_PROFILE, null_mut()) == 0 {
                return Ok(None);
            }
            call(WHAT, |error| {
                sys::rs2_get_video_stream_resolution(profile, &raw mut width, &raw mut height, error);
            })?;
        }
        let size_px = [width, height].map(|side| u32::try_from(side).unwrap_or(0));
        Ok(Some(Self { profile, stream, index, format, rate_hz, size_px }))
    }

    /// Intrinsics of this mode.
    pub(super) fn intrinsics(&self) -> Result<sys::rs2_intrinsics, Problem> {
        let mut intrinsics = MaybeUninit::uninit();
        // SAFETY: the profile lives; without an error all of it was written.
        unsafe {
            call("tell intrinsics", |error| {
                sys::rs2_get_video_stream_intrinsics(self.profile.as_ptr(), intrinsics.as_mut_ptr(), error);
            })?;
            Ok(intrinsics.assume_init())
        }
    }

    /// For what `realsense-rust` does with profiles; not to outlive the mode.
    pub(super) fn profile(&self) -> Result<StreamProfile, Problem> {
        let what = "describe a mode";
        StreamProfile::try_from(self.profile).map_err(|error| Problem::Library { what, reason: error.to_string() })
    }
}

/// Images that wait, of all streams in the order in which they came; the oldest goes where there is no room, but a file waits.
#[derive(Debug)]
pub(super) struct Queue(NonNull<sys::rs2_frame_queue>);

// SAFETY: as for `Context`.
unsafe impl Send for Queue {}

// SAFETY: the library locks its queues.
unsafe impl Sync for Queue {}

impl Queue {
    pub(super) fn new(capacity: u8) -> Result<Self, Problem> {
        const WHAT: &str = "make a queue";
        // SAFETY: only numbers go in.
        let queue = call(WHAT, |error| unsafe { sys::rs2_create_frame_queue(capacity.into(), error) })?;
        Ok(Self(non_null(WHAT, queue)?))
    }

    /// The next image, or `None` when none came in time.
    pub(super) fn wait(&self, timeout: Duration) -> Result<Option<Frame>, Problem> {
        const WHAT: &str = "wait for an image";
        let millis = u32::try_from(timeout.as_millis()).unwrap_or(u32::MAX);
        let mut frame = null_mut();
        // SAFETY: the queue lives; a frame that came is ours, and `Frame` frees it.
        unsafe {
            let has_arrived =
                call(WHAT, |error| sys::rs2_try_wait_for_frame(self.0.as_ptr(), millis, &raw mut frame, error))?;
            let Some(frame) = NonNull::new(frame).filter(|_| has_arrived != 0) else { return Ok(None) };
            match Frame::try_from(frame) {
                Ok(frame) => Ok(Some(frame)),
                Err(error) => {
                    sys::rs2_release_frame(frame.as_ptr());
                    Err(Problem::Library { what: WHAT, reason: error.to_string() })
                }
            }
        }
    }
}

impl Queue {
    /// Frees all images that wait.
    pub(super) fn empty(&self) -> Result<(), Problem> {
        loop {
            let mut frame = null_mut();
            // SAFETY: the queue lives; a frame that came is ours.
            unsafe {
                call("look for an image", |error| sys::rs2_poll_for_frame(self.0.as_ptr(), &raw mut frame, error))?;
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
        // SAFETY: made by `new`, and no stream runs into it any more.
        unsafe { sys::rs2_delete_frame_queue(self.0.as_ptr()) }
    }
}

/// The bytes of a frame.
pub(super) fn bytes<Kind>(frame: &ImageFrame<Kind>) -> &[u8] {
    // SAFETY: the library keeps so many bytes there as long as the frame lives, and nobody writes them.
    unsafe { std::slice::from_raw_parts(std::ptr::from_ref(frame.get_data()).cast(), frame.get_data_size()) }
}

/// The same frame for what takes depth only.
pub(super) fn as_depth(frame: Frame) -> Result<DepthFrame, Problem> {
    const WHAT: &str = "take a frame as depth";
    // SAFETY: the new wrapper frees the frame in the place of the old one.
    unsafe {
        let raw = frame.get_owned_raw();
        DepthFrame::try_from(raw).map_err(|error| {
            sys::rs2_release_frame(raw.as_ptr());
            Problem::Library { what: WHAT, reason: error.to_string() }
        })
    }
}
