//! A headless OpenGL context. It is current on the thread that created it.
#![expect(unsafe_code, reason = "EGL is a C interface")]

use crate::Error;
use khronos_egl as egl;
use std::ffi::{CStr, c_char, c_void};

type Egl = egl::DynamicInstance<egl::EGL1_5>;

// The constants EGL_PLATFORM_DEVICE_EXT, EGL_PLATFORM_SURFACELESS_MESA and EGL_EXTENSIONS of the
// EGL registry, which the bindings do not contain.
const PLATFORM_DEVICE: egl::Enum = 0x313f;
const PLATFORM_SURFACELESS_MESA: egl::Enum = 0x31dd;
const EXTENSIONS: i32 = 0x3055;
/// Maximum number of devices that are tried. It is larger than the number of devices of any
/// computer.
const MAX_DEVICES: usize = 32;

/// A context without a surface. Dropping it releases the thread and destroys the context.
pub(crate) struct HeadlessContext {
    egl: Egl,
    display: egl::Display,
    context: egl::Context,
    renderer: String,
}

impl HeadlessContext {
    /// Opens the first platform that works. The order is hardware devices, Mesa's surfaceless
    /// platform, software devices.
    ///
    /// On machines with a GPU, Mesa's surfaceless platform may render in software, so hardware
    /// devices come first.
    pub(crate) fn open() -> Result<Self, Error> {
        // SAFETY: loading libEGL runs its initializers, and the system's library is trusted.
        let egl = unsafe { Egl::load_required() }.map_err(|error| Error::NoEgl {
            reason: error.to_string(),
        })?;
        let devices = devices(&egl);
        let hardware = devices.iter().filter(|device| !device.is_software);
        let software = devices.iter().filter(|device| device.is_software);
        let candidates = hardware
            .map(|device| ("hardware device", PLATFORM_DEVICE, device.handle))
            .chain([(
                "surfaceless",
                PLATFORM_SURFACELESS_MESA,
                egl::DEFAULT_DISPLAY,
            )])
            .chain(software.map(|device| ("software device", PLATFORM_DEVICE, device.handle)));
        let mut refused = Vec::new();
        for (what, platform, native) in candidates {
            match make_current(&egl, platform, native) {
                Ok((display, context)) => {
                    let renderer = renderer_name(&egl);
                    log::info!("rendering with {renderer} ({what})");
                    return Ok(Self {
                        egl,
                        display,
                        context,
                        renderer,
                    });
                }
                Err(error) => refused.push(format!("{what}: {error}")),
            }
        }
        Err(Error::NoContext {
            reason: refused.join("; "),
        })
    }

    /// The renderer's name as reported by OpenGL.
    pub(crate) fn renderer(&self) -> &str {
        &self.renderer
    }
}

impl Drop for HeadlessContext {
    fn drop(&mut self) {
        // Errors cannot be reported here. The display is shared by the process and stays open.
        let _ = self.egl.make_current(self.display, None, None, None);
        let _ = self.egl.destroy_context(self.display, self.context);
    }
}

struct Device {
    handle: *mut c_void,
    is_software: bool,
}

fn devices(egl: &Egl) -> Vec<Device> {
    type QueryDevices =
        extern "system" fn(egl::Int, *mut *mut c_void, *mut egl::Int) -> egl::Boolean;
    type QueryDeviceString = extern "system" fn(*mut c_void, egl::Int) -> *const c_char;
    let (Some(query), Some(query_string)) = (
        egl.get_proc_address("eglQueryDevicesEXT"),
        egl.get_proc_address("eglQueryDeviceStringEXT"),
    ) else {
        return Vec::new();
    };
    // SAFETY: the signatures are those of EGL_EXT_device_enumeration and EGL_EXT_device_query.
    let (query, query_string) = unsafe {
        (
            std::mem::transmute::<extern "system" fn(), QueryDevices>(query),
            std::mem::transmute::<extern "system" fn(), QueryDeviceString>(query_string),
        )
    };
    let mut handles = [std::ptr::null_mut(); MAX_DEVICES];
    let mut n_devices = 0;
    let max_devices = egl::Int::try_from(MAX_DEVICES).expect("a small constant");
    if query(max_devices, handles.as_mut_ptr(), &raw mut n_devices) == egl::FALSE {
        return Vec::new();
    }
    let n_devices = usize::try_from(n_devices).unwrap_or(0).min(MAX_DEVICES);
    handles[..n_devices]
        .iter()
        .map(|&handle| {
            let extensions = query_string(handle, EXTENSIONS);
            let is_software = !extensions.is_null()
                // SAFETY: EGL returns a static string that ends in a zero byte.
                && unsafe { CStr::from_ptr(extensions) }.to_string_lossy().contains("EGL_MESA_device_software");
            Device { handle, is_software }
        })
        .collect()
}

fn make_current(
    egl: &Egl,
    platform: egl::Enum,
    native: egl::NativeDisplayType,
) -> Result<(egl::Display, egl::Context), egl::Error> {
    // SAFETY: the native display is null for the surfaceless platform, and a device listed by EGL
    // otherwise.
    let display = unsafe { egl.get_platform_display(platform, native, &[egl::ATTRIB_NONE]) }?;
    egl.initialize(display)?;
    let attributes = [
        (egl::SURFACE_TYPE, egl::PBUFFER_BIT),
        (egl::RENDERABLE_TYPE, egl::OPENGL_BIT),
        (egl::RED_SIZE, 8),
        (egl::GREEN_SIZE, 8),
        (egl::BLUE_SIZE, 8),
        (egl::DEPTH_SIZE, 24),
    ];
    let attributes: Vec<egl::Int> = attributes
        .iter()
        .flat_map(|(key, value)| [*key, *value])
        .chain([egl::NONE])
        .collect();
    let config = egl
        .choose_first_config(display, &attributes)?
        .ok_or(egl::Error::BadConfig)?;
    // The default API of EGL is OpenGL ES, but MuJoCo needs desktop OpenGL.
    egl.bind_api(egl::OPENGL_API)?;
    let context = egl.create_context(display, config, None, &[egl::NONE])?;
    // A context that cannot be made current must not leak, because the next candidate is tried.
    if let Err(error) = egl.make_current(display, None, None, Some(context)) {
        let _ = egl.destroy_context(display, context);
        return Err(error);
    }
    Ok((display, context))
}

fn renderer_name(egl: &Egl) -> String {
    type GetString = extern "system" fn(u32) -> *const c_char;
    const RENDERER: u32 = 0x1f01;
    let Some(get_string) = egl.get_proc_address("glGetString") else {
        return "an unnamed renderer".to_owned();
    };
    // SAFETY: this is the signature of glGetString in OpenGL.
    let get_string = unsafe { std::mem::transmute::<extern "system" fn(), GetString>(get_string) };
    let name = get_string(RENDERER);
    if name.is_null() {
        return "an unnamed renderer".to_owned();
    }
    // SAFETY: a context is current, so OpenGL returns a static string that ends in a zero byte.
    unsafe { CStr::from_ptr(name) }
        .to_string_lossy()
        .into_owned()
}
