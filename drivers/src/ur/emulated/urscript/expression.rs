//! Expressions of URScript.

use super::token::Token;

/// Maximum depth of an expression. Programs come from the network.
const MAX_DEPTH: usize = 32;

/// An expression.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Expression {
    Number(f64),
    Text(String),
    Bool(bool),
    Variable(String),
    List(Vec<Self>),
    Index(Box<Self>, Box<Self>),
    Call(FunctionCall),
    Negative(Box<Self>),
    Not(Box<Self>),
    Binary(Operator, Box<Self>, Box<Self>),
}

/// A call of a function of the controller.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct FunctionCall {
    pub(super) name: String,
    pub(super) arguments: Vec<Expression>,
    pub(super) named: Vec<(String, Expression)>,
}

/// Operators with two operands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Operator {
    Or,
    And,
    Equal,
    NotEqual,
    Less,
    LessOrEqual,
    Greater,
    GreaterOrEqual,
    Plus,
    Minus,
    Times,
    DividedBy,
}

/// Operators by precedence, from the weakest. Words are names, and the others symbols.
const LEVELS: [&[(&str, Operator)]; 5] = [
    &[("or", Operator::Or)],
    &[("and", Operator::And)],
    &[
        ("==", Operator::Equal),
        ("!=", Operator::NotEqual),
        ("<=", Operator::LessOrEqual),
        (">=", Operator::GreaterOrEqual),
        ("<", Operator::Less),
        (">", Operator::Greater),
    ],
    &[("+", Operator::Plus), ("-", Operator::Minus)],
    &[("*", Operator::Times), ("/", Operator::DividedBy)],
];

/// Reads expressions from the tokens of a line.
pub(super) struct ExpressionReader<'a> {
    tokens: &'a [Token],
    depth: usize,
}

impl<'a> ExpressionReader<'a> {
    pub(super) fn new(tokens: &'a [Token]) -> Self {
        Self { tokens, depth: 0 }
    }

    /// Reads one expression, which must end with the tokens.
    pub(super) fn only(mut self) -> Result<Expression, String> {
        let expression = self.expression(0)?;
        match self.tokens.first() {
            None => Ok(expression),
            Some(token) => Err(format!("{token:?} follows an expression")),
        }
    }

    fn expression(&mut self, level: usize) -> Result<Expression, String> {
        let Some(operators) = LEVELS.get(level) else {
            return self.operand();
        };
        let mut left = self.expression(level + 1)?;
        while let Some(operator) = self.take_operator(operators) {
            let right = self.expression(level + 1)?;
            left = Expression::Binary(operator, Box::new(left), Box::new(right));
        }
        Ok(left)
    }

    fn take_operator(&mut self, operators: &[(&str, Operator)]) -> Option<Operator> {
        let word: &str = match self.tokens.first()? {
            Token::Symbol(symbol) => symbol,
            Token::Name(name) => name,
            Token::Number(_) | Token::Text(_) => return None,
        };
        let (_, operator) = operators.iter().find(|(known, _)| *known == word)?;
        self.tokens = &self.tokens[1..];
        Some(*operator)
    }

    fn operand(&mut self) -> Result<Expression, String> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(format!(
                "an expression is nested more than {MAX_DEPTH} times"
            ));
        }
        let mut operand = self.primary()?;
        while self.take("[") {
            let index = self.expression(0)?;
            self.expect("]")?;
            operand = Expression::Index(Box::new(operand), Box::new(index));
        }
        self.depth -= 1;
        Ok(operand)
    }

    fn primary(&mut self) -> Result<Expression, String> {
        if self.take("(") {
            let inner = self.expression(0)?;
            self.expect(")")?;
            return Ok(inner);
        }
        if self.take("-") {
            return Ok(Expression::Negative(Box::new(self.operand()?)));
        }
        if self.take("[") {
            return Ok(Expression::List(self.list()?));
        }
        let Some((token, rest)) = self.tokens.split_first() else {
            return Err("an expression is missing".to_owned());
        };
        self.tokens = rest;
        Ok(match token {
            Token::Number(number) => Expression::Number(*number),
            Token::Text(text) => Expression::Text(text.clone()),
            Token::Symbol(symbol) => return Err(format!("{symbol:?} is not an expression")),
            Token::Name(name) => match name.as_str() {
                "True" => Expression::Bool(true),
                "False" => Expression::Bool(false),
                "not" => Expression::Not(Box::new(self.operand()?)),
                _ if self.take("(") => Expression::Call(self.call(name)?),
                _ => Expression::Variable(name.clone()),
            },
        })
    }

    fn list(&mut self) -> Result<Vec<Expression>, String> {
        let mut items = Vec::new();
        while !self.take("]") {
            items.push(self.expression(0)?);
            if !self.take(",") {
                self.expect("]")?;
                break;
            }
        }
        Ok(items)
    }

    fn call(&mut self, name: &str) -> Result<FunctionCall, String> {
        let mut call = FunctionCall {
            name: name.to_owned(),
            arguments: Vec::new(),
            named: Vec::new(),
        };
        while !self.take(")") {
            match self.tokens {
                [Token::Name(name), Token::Symbol("="), rest @ ..] => {
                    self.tokens = rest;
                    let value = self.expression(0)?;
                    call.named.push((name.clone(), value));
                }
                _ => call.arguments.push(self.expression(0)?),
            }
            if !self.take(",") {
                self.expect(")")?;
                break;
            }
        }
        Ok(call)
    }

    fn take(&mut self, symbol: &str) -> bool {
        let is_next = matches!(self.tokens.first(), Some(Token::Symbol(next)) if *next == symbol);
        if is_next {
            self.tokens = &self.tokens[1..];
        }
        is_next
    }

    fn expect(&mut self, symbol: &str) -> Result<(), String> {
        if self.take(symbol) {
            Ok(())
        } else {
            Err(format!(
                "{symbol:?} is missing before {:?}",
                self.tokens.first()
            ))
        }
    }
}
