//! A small part of URScript, for programs that move an emulated arm.
//!
//! `token` splits the text, `expression` and `parse` make instructions, and `machine` runs them one
//! cycle after another. The functions of the controller are not part of the language: the owner of
//! a program provides them.
//!
//! Supported are one function without parameters, assignments, calls, `if`, `elif`, `else`,
//! `while`, numbers, strings, lists, indices, arithmetic and comparisons. Source: "URScript manual".

mod expression;
mod machine;
mod parse;
mod token;
mod value;

pub(super) use machine::{Call, Machine, MachineState, Outcome};
pub(super) use parse::parse;
pub(super) use value::Value;
