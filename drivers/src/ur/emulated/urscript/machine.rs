//! Runs a program, one cycle of the controller after another.

use super::expression::{Expression, FunctionCall, Operator};
use super::parse::{Instruction, Program};
use super::value::Value;
use std::collections::BTreeMap;

/// Maximum number of instructions in a cycle. A real controller reports an infinite loop.
const MAX_INSTRUCTIONS: usize = 10_000;

/// A running program.
#[derive(Debug)]
pub(crate) struct Machine {
    program: Program,
    next: usize,
    variables: BTreeMap<String, Value>,
}

/// Whether a program continues in the next cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MachineState {
    Running,
    Ended,
}

/// A call of a function of the controller, with evaluated arguments.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Call {
    pub(crate) name: String,
    pub(crate) arguments: Vec<Value>,
    pub(crate) named: Vec<(String, Value)>,
}

impl Call {
    /// An argument by position.
    pub(crate) fn argument(&self, ix: usize) -> Result<&Value, String> {
        let argument = self.arguments.get(ix);
        argument.ok_or_else(|| format!("{}: argument {ix} is missing", self.name))
    }

    /// An argument by name.
    pub(crate) fn named(&self, name: &str) -> Result<&Value, String> {
        let argument = self.named.iter().find(|(known, _)| known == name);
        argument
            .map(|(_, value)| value)
            .ok_or_else(|| format!("{}: the argument {name} is missing", self.name))
    }
}

/// Result of a call.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Outcome {
    /// The program continues at once.
    Value(Value),
    /// The call takes the rest of the cycle.
    NextCycle,
    /// The call is not finished, and is repeated in the next cycle.
    Unfinished,
}

/// The functions of the controller.
type Functions<'a> = dyn FnMut(&Call) -> Result<Outcome, String> + 'a;

impl Machine {
    pub(crate) fn new(program: Program) -> Self {
        Self {
            program,
            next: 0,
            variables: BTreeMap::new(),
        }
    }

    /// Runs the program until a call takes the rest of the cycle.
    ///
    /// # Errors
    /// If the program is wrong, or does not end the cycle. A real controller stops the program.
    pub(crate) fn run_cycle(
        &mut self,
        functions: &mut Functions<'_>,
    ) -> Result<MachineState, String> {
        for _ in 0..MAX_INSTRUCTIONS {
            let Some(instruction) = self.program.instructions.get(self.next).cloned() else {
                return Ok(MachineState::Ended);
            };
            self.next += 1;
            match instruction {
                Instruction::Assign(name, expression) => {
                    let value = self.evaluate(&expression, functions)?;
                    self.variables.insert(name, value);
                }
                Instruction::Evaluate(Expression::Call(call)) => {
                    let call = self.call(&call, functions)?;
                    match functions(&call)? {
                        Outcome::Value(_) => {}
                        Outcome::NextCycle => return Ok(MachineState::Running),
                        Outcome::Unfinished => {
                            self.next -= 1;
                            return Ok(MachineState::Running);
                        }
                    }
                }
                Instruction::Evaluate(expression) => {
                    self.evaluate(&expression, functions)?;
                }
                Instruction::JumpUnless(condition, target) => {
                    if !self.evaluate(&condition, functions)?.bool()? {
                        self.next = target;
                    }
                }
                Instruction::Jump(target) => self.next = target,
            }
        }
        Err(format!("{}: a loop takes no time", self.program.name))
    }

    fn evaluate(
        &self,
        expression: &Expression,
        functions: &mut Functions<'_>,
    ) -> Result<Value, String> {
        Ok(match expression {
            Expression::Number(number) => Value::Number(*number),
            Expression::Text(text) => Value::Text(text.clone()),
            Expression::Bool(bool) => Value::Bool(*bool),
            Expression::Variable(name) => {
                let value = self.variables.get(name);
                value
                    .cloned()
                    .ok_or_else(|| format!("the variable {name} has no value"))?
            }
            Expression::List(items) => {
                let numbers: Result<_, _> = items
                    .iter()
                    .map(|item| self.evaluate(item, functions)?.number())
                    .collect();
                Value::List(numbers?)
            }
            Expression::Index(list, index) => {
                let list = self.evaluate(list, functions)?;
                item(&list, self.evaluate(index, functions)?.number()?)?
            }
            Expression::Call(call) => {
                let call = self.call(call, functions)?;
                match functions(&call)? {
                    Outcome::Value(value) => value,
                    _ => return Err(format!("{} takes time inside of an expression", call.name)),
                }
            }
            Expression::Negative(inner) => {
                Value::Number(-self.evaluate(inner, functions)?.number()?)
            }
            Expression::Not(inner) => Value::Bool(!self.evaluate(inner, functions)?.bool()?),
            Expression::Binary(operator, left, right) => {
                let left = self.evaluate(left, functions)?;
                let right = self.evaluate(right, functions)?;
                binary(*operator, &left, &right)?
            }
        })
    }

    fn call(&self, call: &FunctionCall, functions: &mut Functions<'_>) -> Result<Call, String> {
        let arguments: Result<_, String> = call
            .arguments
            .iter()
            .map(|argument| self.evaluate(argument, functions))
            .collect();
        let named: Result<_, String> = call
            .named
            .iter()
            .map(|(name, argument)| Ok((name.clone(), self.evaluate(argument, functions)?)))
            .collect();
        Ok(Call {
            name: call.name.clone(),
            arguments: arguments?,
            named: named?,
        })
    }
}

/// An item of a list.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a cast saturates, and the length is checked"
)]
fn item(list: &Value, index: f64) -> Result<Value, String> {
    let Value::List(numbers) = list else {
        return Err(format!("{list:?} is not a list"));
    };
    let number = numbers.get(index as usize).filter(|_| index >= 0.0);
    number
        .map(|number| Value::Number(*number))
        .ok_or_else(|| format!("the list has no item {index}"))
}

fn binary(operator: Operator, left: &Value, right: &Value) -> Result<Value, String> {
    let numbers = || Ok::<_, String>((left.number()?, right.number()?));
    let compare = |compare: fn(&f64, &f64) -> bool| {
        let (left, right) = numbers()?;
        Ok(Value::Bool(compare(&left, &right)))
    };
    let compute = |compute: fn(f64, f64) -> f64| {
        let (left, right) = numbers()?;
        Ok(Value::Number(compute(left, right)))
    };
    match operator {
        Operator::Or => Ok(Value::Bool(left.bool()? || right.bool()?)),
        Operator::And => Ok(Value::Bool(left.bool()? && right.bool()?)),
        Operator::Equal => Ok(Value::Bool(left == right)),
        Operator::NotEqual => Ok(Value::Bool(left != right)),
        Operator::Less => compare(f64::lt),
        Operator::LessOrEqual => compare(f64::le),
        Operator::Greater => compare(f64::gt),
        Operator::GreaterOrEqual => compare(f64::ge),
        Operator::Plus => compute(|left, right| left + right),
        Operator::Minus => compute(|left, right| left - right),
        Operator::Times => compute(|left, right| left * right),
        Operator::DividedBy => compute(|left, right| left / right),
    }
}

#[cfg(test)]
mod tests {
    use super::super::parse::parse;
    use super::*;

    /// Runs a program, and returns the values that it wrote with `write`, cycle by cycle.
    fn run(text: &str, max_cycles: usize) -> Result<Vec<Vec<f64>>, String> {
        let mut machine = Machine::new(parse(text)?);
        let mut cycles = Vec::new();
        for _ in 0..max_cycles {
            let mut written = Vec::new();
            let state = machine.run_cycle(&mut |call| match call.name.as_str() {
                "write" => {
                    written.push(call.argument(0)?.number()?);
                    Ok(Outcome::Value(Value::None))
                }
                "norm" => Ok(Outcome::Value(Value::Number(
                    call.argument(0)?.number()?.abs(),
                ))),
                "sync" => Ok(Outcome::NextCycle),
                "step" => Ok(Outcome::Value(call.named("t")?.clone())),
                name => Err(format!("{name} is unknown")),
            })?;
            cycles.push(written);
            if state == MachineState::Ended {
                break;
            }
        }
        Ok(cycles)
    }

    #[test]
    fn loops_and_branches_run_cycle_by_cycle() {
        let text = "def test():
  count = 0
  while count < 4:  # four cycles
    if count == 0:
      write(10)
    elif count == 1 and not False:
      write(11)
    elif count == 2 or False:
      write(-12)
    else:
      write([7, 8, 13][2])
    end
    count = count + step(t=1)
    sync()
  end
  write(norm(2 - 3 * 4) / 5)
end
";
        let expected = [vec![10.0], vec![11.0], vec![-12.0], vec![13.0], vec![2.0]];
        assert_eq!(run(text, 10).unwrap(), expected);
    }

    #[test]
    fn wrong_programs_are_errors() {
        for (text, expected) in [
            ("def test():\n  sync()\n", "incomplete"),
            ("sync()\n", "def NAME"),
            ("def test():\n  if True\n  end\nend\n", "colon"),
            ("def test():\n  else:\n  end\nend\n", "without `if`"),
            ("def test():\n  x = (1\nend\n", "missing"),
            ("def test():\n  x = \"a\nend\n", "does not end"),
            ("def test():\n  x = y\nend\n", "no value"),
            ("def test():\n  fly()\nend\n", "fly is unknown"),
            ("def test():\n  while True:\n  end\nend\n", "takes no time"),
            ("def test():\n  write([1][1])\nend\n", "no item 1"),
            ("def test():\nend\nsync()\n", "follows the end"),
        ] {
            let error = run(text, 3).unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
        let deep = format!("def test():\n  x = {}1\nend\n", "(".repeat(10_000));
        assert!(run(&deep, 3).unwrap_err().contains("nested"));
    }
}
