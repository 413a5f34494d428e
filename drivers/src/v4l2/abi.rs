//! The part of the kernel's V4L2 interface that cameras need. It consists of structures, constants
//! and request codes of `linux/videodev2.h` and `linux/v4l2-controls.h` on 64-bit Linux.

use rustix::ioctl::{Opcode, opcode};

/// `V4L2_BUF_TYPE_VIDEO_CAPTURE`.
pub(super) const VIDEO_CAPTURE: u32 = 1;
/// `V4L2_MEMORY_MMAP`.
pub(super) const MEMORY_MMAP: u32 = 1;
/// `V4L2_FIELD_ANY` and `V4L2_FIELD_NONE`. The second value requests progressive images instead of
/// interlaced images.
pub(super) const FIELD_ANY: u32 = 0;
pub(super) const FIELD_NONE: u32 = 1;

/// `V4L2_CAP_*`.
pub(super) const CAP_VIDEO_CAPTURE: u32 = 0x0000_0001;
pub(super) const CAP_STREAMING: u32 = 0x0400_0000;
pub(super) const CAP_DEVICE_CAPS: u32 = 0x8000_0000;
/// `V4L2_CAP_TIMEPERFRAME`, of `CaptureParm::capability`.
pub(super) const CAP_TIMEPERFRAME: u32 = 0x1000;
/// `V4L2_IN_CAP_DV_TIMINGS`, which marks a digital video input, as on HDMI grabbers.
pub(super) const INPUT_DV_TIMINGS: u32 = 0x2;

/// `V4L2_BUF_FLAG_*`.
pub(super) const BUFFER_ERROR: u32 = 0x40;
pub(super) const BUFFER_CLOCK_MASK: u32 = 0xe000;
pub(super) const BUFFER_CLOCK_MONOTONIC: u32 = 0x2000;

/// `V4L2_FRMSIZE_TYPE_DISCRETE` and `V4L2_FRMIVAL_TYPE_DISCRETE`.
pub(super) const DISCRETE: u32 = 1;

/// `V4L2_CTRL_FLAG_DISABLED` and `V4L2_CTRL_FLAG_READ_ONLY`.
pub(super) const CONTROL_DISABLED: u32 = 0x1;
pub(super) const CONTROL_READ_ONLY: u32 = 0x4;
/// `V4L2_CTRL_TYPE_MENU`.
pub(super) const CONTROL_MENU: u32 = 3;

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct Capability {
    pub(super) driver: [u8; 16],
    pub(super) card: [u8; 32],
    pub(super) bus_info: [u8; 32],
    pub(super) version: u32,
    pub(super) capabilities: u32,
    pub(super) device_caps: u32,
    pub(super) reserved: [u32; 3],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct FormatDescription {
    pub(super) index: u32,
    pub(super) kind: u32,
    pub(super) flags: u32,
    pub(super) description: [u8; 32],
    pub(super) fourcc: u32,
    pub(super) mbus_code: u32,
    pub(super) reserved: [u32; 3],
}

/// `struct v4l2_format` for video capture. The union in it is aligned to 8 bytes because other
/// members hold pointers.
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct Format {
    pub(super) kind: u32,
    pub(super) padding: u32,
    pub(super) pix: PixFormat,
    pub(super) rest: [u64; 19],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct PixFormat {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) fourcc: u32,
    pub(super) field: u32,
    pub(super) bytes_per_line: u32,
    pub(super) size_image: u32,
    pub(super) colorspace: u32,
    pub(super) private: u32,
    pub(super) flags: u32,
    pub(super) ycbcr_enc: u32,
    pub(super) quantization: u32,
    pub(super) xfer_func: u32,
}

/// Fraction of a second.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct Fraction {
    pub(super) numerator: u32,
    pub(super) denominator: u32,
}

/// `struct v4l2_streamparm` for video capture.
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct StreamParm {
    pub(super) kind: u32,
    pub(super) capture: CaptureParm,
    pub(super) rest: [u32; 40],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct CaptureParm {
    pub(super) capability: u32,
    pub(super) capture_mode: u32,
    pub(super) time_per_frame: Fraction,
    pub(super) extended_mode: u32,
    pub(super) read_buffers: u32,
    pub(super) reserved: [u32; 4],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct FrameSize {
    pub(super) index: u32,
    pub(super) fourcc: u32,
    pub(super) kind: u32,
    /// Width and height, if the type is discrete. Otherwise, minimum, maximum and step of the
    /// width, then of the height.
    pub(super) numbers: [u32; 6],
    pub(super) reserved: [u32; 2],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct FrameInterval {
    pub(super) index: u32,
    pub(super) fourcc: u32,
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) kind: u32,
    /// If the type is discrete, only the first fraction is used. Otherwise, the fractions are
    /// minimum, maximum and step.
    pub(super) fractions: [Fraction; 3],
    pub(super) reserved: [u32; 2],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct RequestBuffers {
    pub(super) count: u32,
    pub(super) kind: u32,
    pub(super) memory: u32,
    pub(super) capabilities: u32,
    pub(super) flags: u32,
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct Buffer {
    pub(super) index: u32,
    pub(super) kind: u32,
    pub(super) bytes_used: u32,
    pub(super) flags: u32,
    pub(super) field: u32,
    pub(super) padding: u32,
    pub(super) secs: i64,
    pub(super) micros: i64,
    pub(super) timecode: [u32; 4],
    pub(super) sequence: u32,
    pub(super) memory: u32,
    /// With `MEMORY_MMAP`, this is the offset of the buffer for `mmap`. The union has the size of a
    /// pointer.
    pub(super) offset: u32,
    pub(super) offset_padding: u32,
    pub(super) length: u32,
    pub(super) reserved: [u32; 3],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct Control {
    pub(super) id: u32,
    pub(super) value: i32,
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct QueryControl {
    pub(super) id: u32,
    pub(super) kind: u32,
    pub(super) name: [u8; 32],
    pub(super) minimum: i32,
    pub(super) maximum: i32,
    pub(super) step: i32,
    pub(super) default_value: i32,
    pub(super) flags: u32,
    pub(super) reserved: [u32; 2],
}

/// `struct v4l2_querymenu`. It is packed, but its size is still a multiple of 4.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct QueryMenu {
    pub(super) id: u32,
    pub(super) index: u32,
    pub(super) name: [u8; 32],
    pub(super) reserved: u32,
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct Input {
    pub(super) index: u32,
    pub(super) name: [u8; 32],
    pub(super) kind: u32,
    pub(super) audioset: u32,
    pub(super) tuner: u32,
    pub(super) standards: u64,
    pub(super) status: u32,
    pub(super) capabilities: u32,
    pub(super) reserved: [u32; 4],
}

/// A kernel structure that consists only of integers, so any bytes that the kernel writes are a
/// valid value.
pub(super) trait Plain: Copy {}
impl Plain for Capability {}
impl Plain for FormatDescription {}
impl Plain for Format {}
impl Plain for StreamParm {}
impl Plain for FrameSize {}
impl Plain for FrameInterval {}
impl Plain for RequestBuffers {}
impl Plain for Buffer {}
impl Plain for Control {}
impl Plain for QueryControl {}
impl Plain for QueryMenu {}
impl Plain for Input {}
impl Plain for u32 {}

/// A request code and the type of its argument. Only this file creates requests, from the request
/// codes of the kernel.
pub(super) struct Request<T> {
    code: Opcode,
    payload: std::marker::PhantomData<T>,
}

impl<T> Request<T> {
    pub(super) const fn code(&self) -> Opcode {
        self.code
    }
}

const fn read_write_request<T>(number: u8) -> Request<T> {
    Request {
        code: opcode::read_write::<T>(b'V', number),
        payload: std::marker::PhantomData,
    }
}

const fn read_request<T>(number: u8) -> Request<T> {
    Request {
        code: opcode::read::<T>(b'V', number),
        payload: std::marker::PhantomData,
    }
}

const fn write_request<T>(number: u8) -> Request<T> {
    Request {
        code: opcode::write::<T>(b'V', number),
        payload: std::marker::PhantomData,
    }
}

pub(super) const QUERYCAP: Request<Capability> = read_request(0);
pub(super) const ENUM_FMT: Request<FormatDescription> = read_write_request(2);
pub(super) const S_FMT: Request<Format> = read_write_request(5);
pub(super) const REQBUFS: Request<RequestBuffers> = read_write_request(8);
pub(super) const QUERYBUF: Request<Buffer> = read_write_request(9);
pub(super) const QBUF: Request<Buffer> = read_write_request(15);
pub(super) const DQBUF: Request<Buffer> = read_write_request(17);
pub(super) const STREAMON: Request<u32> = write_request(18);
pub(super) const STREAMOFF: Request<u32> = write_request(19);
pub(super) const G_PARM: Request<StreamParm> = read_write_request(21);
pub(super) const S_PARM: Request<StreamParm> = read_write_request(22);
pub(super) const ENUMINPUT: Request<Input> = read_write_request(26);
pub(super) const G_CTRL: Request<Control> = read_write_request(27);
pub(super) const S_CTRL: Request<Control> = read_write_request(28);
pub(super) const QUERYCTRL: Request<QueryControl> = read_write_request(36);
pub(super) const QUERYMENU: Request<QueryMenu> = read_write_request(37);
pub(super) const G_INPUT: Request<u32> = read_request(38);
pub(super) const ENUM_FRAMESIZES: Request<FrameSize> = read_write_request(74);
pub(super) const ENUM_FRAMEINTERVALS: Request<FrameInterval> = read_write_request(75);

// Request codes contain the size of the structure. The kernel rejects a wrong size as an unknown
// request.
const _: () = {
    assert!(size_of::<Capability>() == 104);
    assert!(size_of::<FormatDescription>() == 64);
    assert!(size_of::<Format>() == 208);
    assert!(size_of::<StreamParm>() == 204);
    assert!(size_of::<FrameSize>() == 44);
    assert!(size_of::<FrameInterval>() == 52);
    assert!(size_of::<RequestBuffers>() == 20);
    assert!(size_of::<Buffer>() == 88);
    assert!(size_of::<Control>() == 8);
    assert!(size_of::<QueryControl>() == 68);
    assert!(size_of::<QueryMenu>() == 44);
    assert!(size_of::<Input>() == 80);
};

/// Decodes null-terminated text.
pub(super) fn text(bytes: &[u8]) -> String {
    let end = bytes
        .iter()
        .position(|byte| *byte == 0)
        .unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compiles a C program against the kernel's header, if available, and compares request codes
    /// and field offsets.
    #[test]
    fn abi_matches_kernel_header() {
        let header = std::path::Path::new("/usr/include/linux/videodev2.h");
        if !header.exists() {
            test_support::skip(format_args!("{header:?} does not exist"));
            return;
        }
        macro_rules! rows {
            ($($name:ident),*; $($ours:ident . $field:ident = $kernel_value:literal),*) => {
                (
                    vec![$((concat!("VIDIOC_", stringify!($name)).to_owned(), u64::from($name.code()))),*],
                    vec![$((format!("offsetof(struct {})", $kernel_value), std::mem::offset_of!($ours, $field) as u64)),*],
                )
            };
        }
        let (codes, offsets) = rows!(
            QUERYCAP, ENUM_FMT, S_FMT, REQBUFS, QUERYBUF, QBUF, DQBUF, STREAMON, STREAMOFF, G_PARM, S_PARM, ENUMINPUT,
            G_CTRL, S_CTRL, QUERYCTRL, QUERYMENU, G_INPUT, ENUM_FRAMESIZES, ENUM_FRAMEINTERVALS;
            Capability.device_caps = "v4l2_capability, device_caps",
            FormatDescription.fourcc = "v4l2_fmtdesc, pixelformat",
            Format.pix = "v4l2_format, fmt.pix",
            PixFormat.size_image = "v4l2_pix_format, sizeimage",
            PixFormat.quantization = "v4l2_pix_format, quantization",
            StreamParm.capture = "v4l2_streamparm, parm.capture",
            CaptureParm.time_per_frame = "v4l2_captureparm, timeperframe",
            FrameSize.numbers = "v4l2_frmsizeenum, discrete",
            FrameInterval.fractions = "v4l2_frmivalenum, discrete",
            Buffer.secs = "v4l2_buffer, timestamp",
            Buffer.sequence = "v4l2_buffer, sequence",
            Buffer.offset = "v4l2_buffer, m.offset",
            Buffer.length = "v4l2_buffer, length",
            QueryControl.minimum = "v4l2_queryctrl, minimum",
            QueryControl.flags = "v4l2_queryctrl, flags",
            QueryMenu.name = "v4l2_querymenu, name",
            Input.status = "v4l2_input, status",
            Input.capabilities = "v4l2_input, capabilities"
        );
        let expected: Vec<(String, u64)> = codes.into_iter().chain(offsets).collect();
        let c_print = |(what, _): &(String, u64)| {
            format!("printf(\"%llu\\n\", (unsigned long long){what});\n")
        };
        let program = format!(
            "#include <stddef.h>\n#include <stdio.h>\n#include <linux/videodev2.h>\nint main(void) {{\n{}return 0; }}\n",
            expected.iter().map(c_print).collect::<String>()
        );
        let folder = tempfile::tempdir().expect("a folder");
        let (source, built) = (folder.path().join("abi.c"), folder.path().join("abi"));
        std::fs::write(&source, program).expect("writing the C program");
        let compiler = std::process::Command::new("cc")
            .arg(&source)
            .arg("-o")
            .arg(&built)
            .status();
        assert!(
            compiler
                .expect("a C compiler, which Rust also needs")
                .success()
        );
        let output = std::process::Command::new(&built)
            .output()
            .expect("running the C program");
        let reported: Vec<u64> = String::from_utf8_lossy(&output.stdout)
            .lines()
            .map(|line| line.parse().expect("a number"))
            .collect();
        assert_eq!(reported.len(), expected.len());
        let wrong: Vec<_> = expected
            .iter()
            .zip(&reported)
            .filter(|((_, ours), kernel_value)| ours != *kernel_value)
            .collect();
        assert!(wrong.is_empty(), "{wrong:?}");
    }

    #[test]
    fn text_ends_at_nul() {
        assert_eq!(text(b"vivid\0\0garbage"), "vivid");
        assert_eq!(text(b"full"), "full");
    }
}
