//! Reads and writes objects of a drive, maps its PDOs, and starts it.

use crate::Error;
use crate::can::family::MAX_REPORT;
use crate::can::query::MotorQuery;
use crate::wire::can::CanError;
use crate::wire::can::canopen::{self, Direction, Nmt, Node, NodeState, Object, Pdo, SdoAnswer};

/// PDO communication entry 2: send at every SYNC.
const EVERY_SYNC: i64 = 1;
/// Bit of PDO communication entry 1 that disables the PDO.
const PDO_OFF: i64 = 1 << 31;

/// Reads an object. If it is shorter than the result, the upper bytes are 0.
pub(super) fn get(query: &MotorQuery<'_>, node: Node, object: Object) -> Result<u32, Error> {
    let answer =
        query.request_answer(
            &canopen::encode_read(node, object),
            |frame| match canopen::decode_sdo(frame) {
                Ok((
                    from,
                    SdoAnswer::Value {
                        object: reported,
                        raw,
                    },
                )) => (from == node
                    && (reported.index, reported.subindex) == (object.index, object.subindex))
                    .then_some(Ok(raw)),
                Err(
                    error @ (CanError::Aborted { index, .. } | CanError::Segmented { index, .. }),
                ) => (index == object.index).then_some(Err(error)),
                _ => None,
            },
        )?;
    query.map_error(answer)
}

/// Writes an object and verifies it.
pub(super) fn set_and_check(
    query: &MotorQuery<'_>,
    node: Node,
    object: Object,
    value: i64,
) -> Result<(), Error> {
    set(query, node, object, value)?;
    // The value may be negative, and the bytes of the answer beyond the object are undefined. Only
    // the bytes of the object are compared.
    let bits = u32::MAX >> (32 - 8 * u32::from(object.n_bytes));
    let reported = get(query, node, object)? & bits;
    if i64::from(reported) == value & i64::from(bits) {
        Ok(())
    } else {
        Err(query.fault(format!(
            "object {:#06x}:{:02x} was set to {value} but reads back as {reported:#x}",
            object.index, object.subindex
        )))
    }
}

/// Writes an object.
pub(super) fn set(
    query: &MotorQuery<'_>,
    node: Node,
    object: Object,
    value: i64,
) -> Result<(), Error> {
    let answer = try_set(query, node, object, value)?;
    query.map_error(answer)
}

/// Like [`set`], but returns an error as the inner result if the node refuses the value.
pub(super) fn try_set(
    query: &MotorQuery<'_>,
    node: Node,
    object: Object,
    value: i64,
) -> Result<Result<(), CanError>, Error> {
    let poll_frame = query.map_error(canopen::encode_write(node, object, value))?;
    query.request_answer(&poll_frame, |frame| match canopen::decode_sdo(frame) {
        Ok((from, SdoAnswer::Written { index, subindex })) => {
            (from == node && (index, subindex) == (object.index, object.subindex)).then_some(Ok(()))
        }
        Err(error @ CanError::Aborted { index, .. }) => {
            (index == object.index).then_some(Err(error))
        }
        _ => None,
    })
}

/// The entries that map objects into a PDO of a drive, so that the drive sends or accepts the PDO
/// on every SYNC.
///
/// Source: CiA 301, section 7.5.2.36: a PDO is disabled while its mapping is changed.
pub(super) fn map_pdo_at_every_sync(
    pdo: Pdo,
    direction: Direction,
    node: Node,
    objects: &[Object],
) -> Vec<(Object, i64)> {
    let id = i64::from(pdo.id(direction, node).value());
    let mut entries = vec![
        // The PDO is disabled first, and then its number of mapped objects is set to 0. Otherwise,
        // drives refuse changes of the mapping.
        (pdo.communication(direction, 1), id | PDO_OFF),
        (pdo.mapping(direction, 0), 0),
    ];
    for (place, object) in (1..).zip(objects) {
        entries.push((pdo.mapping(direction, place), object.mapped().into()));
    }
    // The number of objects is written last, because the drive then checks and accepts the mapping.
    entries.push((
        pdo.mapping(direction, 0),
        i64::try_from(objects.len()).expect("at most eight objects"),
    ));
    entries.extend([
        (pdo.communication(direction, 2), EVERY_SYNC),
        (pdo.communication(direction, 1), id),
    ]);
    entries
}

/// Writes entries while a drive's PDOs are inactive, then starts the PDOs.
pub(super) fn start_drive(
    query: &MotorQuery<'_>,
    node: Node,
    entries: &[(Object, i64)],
) -> Result<(), Error> {
    // PDOs are inactive in the pre-operational state, so no half-configured PDO is sent or
    // accepted.
    query.send(Ok(canopen::encode_nmt(
        Nmt::EnterPreOperational,
        Some(node),
    )))?;
    for (object, value) in entries {
        set(query, node, *object, *value)?;
    }
    query.send(Ok(canopen::encode_nmt(Nmt::Start, Some(node))))?;
    // NMT commands have no answer. The next heartbeat shows whether the drive has executed this
    // one.
    let started = query.wait(MAX_REPORT, |frame| match canopen::decode_heartbeat(frame) {
        Ok((from, NodeState::Operational)) => (from == node).then_some(()),
        _ => None,
    })?;
    started.ok_or_else(|| {
        query.fault("the drive was started but did not report the operational state")
    })
}
