//! The JSON schema of rig files (draft 7), for editors. It is made from the tables that check the
//! keys, so it has the same names, types, ranges and defaults.
//!
//! The schema accepts every valid rig file. It does not express rules that relate several keys,
//! such as an exposure of at most one frame period, or that depend on other files. These rules are
//! only checked when a rig file is read.

use super::key::table_of;
use super::table_schema::{PLAIN_NAME, TableSchema, one_or_more};
use super::{JoinConfig, Rig, Train, arm, base, camera, scanner, sim};
use serde_json::{Value, json};

/// Version of JSON schema that the editors support.
const DRAFT: &str = "http://json-schema.org/draft-07/schema#";

impl Rig {
    /// The JSON schema of rig files. `methods` are the names of the scene models, which are not
    /// known to this crate.
    #[must_use]
    pub fn json_schema(methods: &[&str]) -> Value {
        let mut train = table_of::<Train>();
        let names = json!({ "type": "string", "enum": methods });
        train.refine("method", |method| {
            method.insert("anyOf".to_owned(), one_or_more(&names, 1));
        });
        let mut rig = TableSchema::default();
        rig.table(
            "arm",
            "The arm of the rig, and its robot description.",
            arm::schema(),
        );
        rig.table("base", "Pose of the base and its source.", base::schema());
        let about = "The cameras. Each table has a name, such as [camera.wrist].";
        rig.named("camera", about, PLAIN_NAME, camera::schema());
        let about = "Range scanners that rotate about their z axis. Each table has a name, such as [range.lidar].";
        rig.named("range", about, PLAIN_NAME, scanner::schema());
        let about = "Which images become keyframes, and how many are kept.";
        rig.table("join", about, table_of::<JoinConfig>());
        rig.table("train", "How the model is trained.", train);
        let about = "The simulator, which can replace the devices of a rig, and is used by drivers named sim.";
        rig.table("sim", about, sim::schema());
        rig.require("arm");
        let Value::Object(mut schema) = rig.into_json() else {
            return Value::Null;
        };
        schema.insert("$schema".to_owned(), DRAFT.into());
        schema.insert("title".to_owned(), "Rig file of fieldrig".into());
        Value::Object(schema)
    }
}
