//! Functions of librealsense2 for software devices that `realsense-sys` does not declare.
//!
//! Source: `include/librealsense2/h/rs_internal.h` of 2.56.

use realsense_sys as sys;
use std::ffi::{c_char, c_int, c_void};

/// `rs2_video_stream`.
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct VideoStream {
    pub(super) stream: sys::rs2_stream,
    pub(super) index: c_int,
    pub(super) unique_id: c_int,
    pub(super) width: c_int,
    pub(super) height: c_int,
    pub(super) rate_hz: c_int,
    pub(super) bytes_per_pixel: c_int,
    pub(super) format: sys::rs2_format,
    pub(super) intrinsics: sys::rs2_intrinsics,
}

/// `rs2_software_video_frame`.
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct VideoFrame {
    pub(super) pixels: *mut c_void,
    pub(super) deleter: extern "C" fn(*mut c_void),
    pub(super) bytes_per_line: c_int,
    pub(super) bytes_per_pixel: c_int,
    pub(super) millis: f64,
    pub(super) domain: sys::rs2_timestamp_domain,
    pub(super) number: c_int,
    pub(super) profile: *const sys::rs2_stream_profile,
    pub(super) meters_per_count: f32,
}

unsafe extern "C" {
    pub(super) fn rs2_create_software_device(
        error: *mut *mut sys::rs2_error,
    ) -> *mut sys::rs2_device;
    pub(super) fn rs2_software_device_register_info(
        device: *mut sys::rs2_device,
        info: sys::rs2_camera_info,
        value: *const c_char,
        error: *mut *mut sys::rs2_error,
    );
    pub(super) fn rs2_software_device_add_sensor(
        device: *mut sys::rs2_device,
        name: *const c_char,
        error: *mut *mut sys::rs2_error,
    ) -> *mut sys::rs2_sensor;
    pub(super) fn rs2_software_sensor_add_video_stream_ex(
        sensor: *mut sys::rs2_sensor,
        stream: VideoStream,
        is_default: c_int,
        error: *mut *mut sys::rs2_error,
    ) -> *mut sys::rs2_stream_profile;
    pub(super) fn rs2_software_sensor_add_read_only_option(
        sensor: *mut sys::rs2_sensor,
        option: sys::rs2_option,
        value: f32,
        error: *mut *mut sys::rs2_error,
    );
    pub(super) fn rs2_software_sensor_set_metadata(
        sensor: *mut sys::rs2_sensor,
        key: sys::rs2_frame_metadata_value,
        value: sys::rs2_metadata_type,
        error: *mut *mut sys::rs2_error,
    );
    pub(super) fn rs2_software_sensor_on_video_frame(
        sensor: *mut sys::rs2_sensor,
        frame: VideoFrame,
        error: *mut *mut sys::rs2_error,
    );
}
